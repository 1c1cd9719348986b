import json
import shutil

import pytest
import torch
from torchrl.checkpoint import GlobalRNGState

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.results import read_result
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training import experiment as experiments
from ba_torchrl.training.checkpoint import (
    check_same_run,
    find_checkpoint,
    load,
    read_config,
    saved_steps,
)
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.experiment import Experiment
from tests.training import test_experiment

TINY = {
    **test_experiment.TINY,
    "total_updates": 9,
    "eval_episodes": 2,
    "final_eval_episodes": 2,
    "video_episodes": 0,
}


class Interrupted(BaseException):
    """An exception that no code handles."""


def raise_interrupted(*_):
    raise Interrupted


def config_for(tmp_path, **changes):
    return ExperimentConfig.parse({**TINY, "run_dir": str(tmp_path / "run"), **changes})


def run(config):
    return Experiment(config, progress=False).run()


def interrupt(config, after):
    """Run for a number of updates, then interrupt the run; return the experiment."""
    experiment = Experiment(config, progress=False)
    update = experiment.learner.update

    def update_or_stop():
        if experiment.learner.updates == after:
            raise Interrupted
        return update()

    experiment.learner.update = update_or_stop
    with pytest.raises(Interrupted):
        experiment.run()
    return experiment


@pytest.fixture(scope="module")
def interrupted_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("interrupted")
    interrupt(config_for(folder), after=4)
    return folder / "run"


@pytest.fixture
def interrupted(interrupted_run, tmp_path):
    """The configuration of a run that was interrupted after four updates."""
    config = config_for(tmp_path)
    shutil.copytree(interrupted_run, config.folder)
    return config


def test_a_checkpoint_missing_after_an_interruption_is_written(tmp_path):
    config = config_for(tmp_path)
    experiment = Experiment(config, progress=False)
    experiment.checkpoints.save = raise_interrupted  # called after the first state is saved
    with pytest.raises(Interrupted):
        experiment.run()
    assert not (config.folder / "checkpoints").exists()
    experiment = Experiment(config_for(tmp_path, resume=True), progress=False)
    assert experiment._resume()
    experiment.close()
    assert find_checkpoint(config.folder).name.endswith("3")


def test_an_interruption_after_the_last_evaluation_repeats_no_update(tmp_path):
    config = config_for(tmp_path)
    experiment = Experiment(config, progress=False)
    rotation, kept = experiment.checkpoints._rotation, []

    def prune():
        kept.append(len(saved_steps(rotation.directory)))
        if len(kept) == 3:
            raise Interrupted

    rotation.prune = prune
    with pytest.raises(Interrupted):
        experiment.run()
    assert kept == [1, 2, 3]
    state, disk = config.folder / "resume", tmp_path / "larger disk"
    state.rename(disk)
    state.symlink_to(disk)
    experiment = Experiment(config_for(tmp_path, resume=True), progress=False)
    experiment.learner.update = None
    assert experiment.run().updates == 9
    result = read_result(config.folder)
    assert [point.updates for point in result.curve] == [0, 3, 6, 9]
    assert result.resumed_at == [9]
    assert len(saved_steps(rotation.directory)) == 2
    assert not disk.exists()


def test_a_run_interrupted_before_its_first_state_starts_again(tmp_path, caplog, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(experiments, "evaluate", raise_interrupted)
        with pytest.raises(Interrupted):
            run(config_for(tmp_path))
    (tmp_path / "run/.12.0a1b2c.config.json").touch()  # of a process that was killed
    (tmp_path / "run/.12.notes").touch()
    result = run(config_for(tmp_path, resume=True))
    assert "has no saved state yet" in caplog.text
    assert {path.name for path in (tmp_path / "run").glob(".*")} == {".12.notes"}
    assert result.updates == 9
    assert result.resumed_at == []


def test_a_changed_configuration_is_refused_by_name(interrupted, tmp_path, monkeypatch):
    config = interrupted
    before = (config.folder / "config.json").read_bytes()
    changed = config_for(
        tmp_path,
        resume=True,
        total_updates=12,
        env={**TINY["env"], "max_steps": 9},
        algorithm={**TINY["algorithm"], "gamma": 0.9},
        seed=1,
    )
    with pytest.raises(ConfigError) as error:
        Experiment(changed, progress=False)
    for line in (
        "algorithm.gamma: 0.99 there, 0.9 now",
        "env.max_steps: 8 there, 9 now",
        "seed: 0 there, 1 now",
        "total_updates: 9 there, 12 now",
    ):
        assert line in str(error.value)
    assert str(error.value).count(" there, ") == 4
    monkeypatch.setattr(TASKS[TINY["task"]], "expert_version", 1)
    with pytest.raises(ConfigError, match="expert version 1: choose another folder, or use the"):
        check_same_run(config)
    assert (config.folder / "config.json").read_bytes() == before


def test_fields_that_do_not_affect_learning_may_change(interrupted, tmp_path):
    moved = tmp_path / "moved"
    shutil.move(interrupted.folder, moved)
    spelled_out = {**TINY["env"], "robot": "kuka"}  # a default, written down
    other = config_for(
        tmp_path,
        resume=True,
        run_dir=str(moved),
        parallel=True,
        start_method="fork",
        threads=1,
        label="other",
        video_episodes=1,
        env=spelled_out,
    )
    check_same_run(other)
    assert run(other).updates == 9


@pytest.mark.skipif(torch.cuda.is_available(), reason="a machine without a GPU")
def test_a_run_begun_on_cuda_resumes_on_a_cpu(tmp_path, monkeypatch, caplog):
    config = config_for(tmp_path)
    state_dict = GlobalRNGState.state_dict
    with monkeypatch.context() as patch:
        patch.setattr(
            GlobalRNGState,
            "state_dict",
            lambda self: {**state_dict(self), "torch_cuda": [torch.zeros(16, dtype=torch.uint8)]},
        )
        interrupt(config, after=5)
    values = json.loads((config.folder / "config.json").read_text())
    (config.folder / "config.json").write_text(json.dumps({**values, "device": "cuda"}))
    with pytest.raises(ConfigError, match="device: use device=cpu"):
        read_config(config.folder)
    result = run(config_for(tmp_path, resume=True, device="cpu"))
    assert result.updates == 9
    assert read_result(config.folder).resumed_at == [3]
    assert "torch_cuda not restored" in caplog.text
    _, learner = load(config.folder, "latest")
    assert {parameter.device.type for parameter in learner.loss.parameters()} == {"cpu"}


def test_a_folder_with_a_run_is_not_overwritten(interrupted, tmp_path):
    config = interrupted
    with pytest.raises(ConfigError, match="resume=true continues") as refused:
        Experiment(config, progress=False)
    run(config_for(tmp_path, resume=True))
    del refused  # which keeps the experiment, as a notebook does
    before = (config.folder / "result.json").read_bytes()
    for resume in (False, True):
        with pytest.raises(ConfigError, match="finished run"):
            Experiment(config_for(tmp_path, resume=resume), progress=False)
    assert (config.folder / "result.json").read_bytes() == before


def test_checkpoints_without_a_state_are_not_overwritten(interrupted, tmp_path):
    shutil.rmtree(interrupted.folder / "resume")
    with pytest.raises(ConfigError, match="nothing to resume from"):
        Experiment(config_for(tmp_path, resume=True), progress=False)
