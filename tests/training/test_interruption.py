"""Interrupted and resumed runs equal undisturbed ones, bit for bit."""

import os
import signal

import pytest
import torch
from torchrl.checkpoint import GlobalRNGState

from ba_torchrl.algorithms.base import SeedUse
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.logging import read_scalars
from ba_torchrl.record.results import read_result
from ba_torchrl.training import collection, experiment as experiments
from ba_torchrl.training.checkpoint import Checkpoints, resumable_updates, run_holder, saved_steps
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.experiment import Experiment
from ba_torchrl.training.interruption import RunStopped
from tests.tasks.episodes import slow

SAC = {
    "task": "close_loop/block_reaching",
    "env": {"obs_size": 64, "max_steps": 8},
    "algorithm": {
        "name": "sac",
        "batch_size": 4,
        "replay": {"name": "prioritized", "capacity": 60},
    },
    "network": {"name": "cnn", "width": 0.125},
    "num_envs": 2,
    "parallel": False,
    "demonstrations": 2,
    "pretrain_updates": 2,
    "total_updates": 21,
    "updates_per_step": 3,
    "min_replay": 25,
    "eval_every": 8,
    "eval_episodes": 2,
    "final_eval_episodes": 2,
    "log_every": 1,
    "video_episodes": 0,
    "device": "cpu",
}
SDQFD = {
    **SAC,
    "task": "open_loop/block_stacking",
    "env": {"obs_size": 32, "num_objects": 2},
    "algorithm": {"name": "spatial_q", "batch_size": 4},
    "network": {"name": "asr", "width": 0.125},
}


class Killed(BaseException):
    """An exception that no code handles, as after SIGKILL."""


def config_for(folder, base=SAC, **changes):
    return ExperimentConfig.parse({**base, "run_dir": str(folder), **changes})


def outcome(experiment):
    """Return all that a run learnt and recorded."""
    folder = experiment.config.folder
    state = experiment.learner.state_dict()
    excluded = {"seconds", "phase_seconds", "finished", "resumed_at", "files", "config", "curve"}
    excluded |= {"versions"}  # with the commit, which may change between two runs
    result = read_result(folder).model_dump(exclude=excluded)
    curve = [point.model_dump(exclude={"seconds"}) for point in read_result(folder).curve]
    scalars = {
        name: (series.steps.tolist(), series.values.tolist())
        for name, series in read_scalars(folder).items()
    }
    return state, {**result, "curve": curve}, scalars


def assert_same(one, two, path=""):
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, two), path
    elif isinstance(one, dict):
        assert one.keys() == two.keys(), path
        for key in one:
            assert_same(one[key], two[key], f"{path}/{key}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(two), path
        for number, pair in enumerate(zip(one, two, strict=True)):
            assert_same(*pair, f"{path}/{number}")
    else:
        assert one == two or (one != one and two != two), path


def run(config):
    experiment = Experiment(config, progress=False)
    experiment.run()
    return outcome(experiment)


def at_call(experiment, target, method, number, action):
    """Call ``action`` before the given call of a method."""
    original, calls = getattr(target, method), []

    def counted(*args, **kwargs):
        calls.append(None)
        if len(calls) == number:
            action()
        return original(*args, **kwargs)

    setattr(target, method, counted)
    return experiment


def terminate():
    os.kill(os.getpid(), signal.SIGTERM)


def kill():
    raise Killed


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    return run(config_for(tmp_path_factory.mktemp("whole") / "run"))


@pytest.mark.parametrize("after", [20, *slow([1, 3, 4])])
def test_a_run_that_was_stopped_by_a_signal_ends_with_the_same_bits(tmp_path, undisturbed, after):
    experiment = Experiment(config_for(tmp_path), progress=False)
    at_call(experiment, experiment.learner, "update", after, terminate)
    with pytest.raises(RunStopped, match=r"^stopped by SIGTERM, state saved: .*$") as stopped:
        experiment.run()
    assert stopped.value.code == 128 + signal.SIGTERM
    assert resumable_updates(tmp_path) == after
    assert_same(run(config_for(tmp_path, resume=True)), undisturbed)
    result = read_result(tmp_path)
    assert result.resumed_at == [after]
    seconds = [point.seconds for point in result.curve]
    assert seconds == sorted(seconds)
    assert seconds[-1] < result.seconds
    assert resumable_updates(tmp_path) is None
    assert not (tmp_path / "resume").exists()


SELF_IMITATION = {"algorithm": {**SAC["algorithm"], "imitation": {"name": "successes"}}}
FERM = {
    "algorithm": {
        "name": "sac",
        "batch_size": 4,
        "replay": {"name": "uniform", "capacity": 60},
        "views": {"name": "shift"},
        "contrastive": {"name": "info_nce", "updates": 2},
        "optimizer": {"learning_rate_end_factor": 0.1},
    },
    "network": {"name": "ferm", "width": 0.1, "features": 8},
    "pretrain_updates": 0,  # two of the contrastive loss instead
}
"""Optimisers of single terms of the loss, with a schedule."""


FLOW = {
    "algorithm": {"name": "flow", "batch_size": 4, "optimizer": {"policy_average": 0.9}},
    "network": {"name": "equi", "group_order": 4, "n_hidden": 4},
}
PARTS = {"self-imitation": SELF_IMITATION, "ferm": FERM, "flow": FLOW}


@pytest.mark.parametrize("changes", PARTS.values(), ids=PARTS)
def test_other_parts_of_an_algorithm_continue_with_the_same_bits(tmp_path, changes):
    whole = run(config_for(tmp_path / "whole", **changes))
    experiment = Experiment(config_for(tmp_path / "run", **changes), progress=False)
    at_call(experiment, experiment.learner, "update", 10, terminate)
    with pytest.raises(RunStopped):
        experiment.run()
    if changes is SELF_IMITATION:
        assert len(experiment.learner.episodes) > 0  # unfinished ones
    assert_same(run(config_for(tmp_path / "run", **changes, resume=True)), whole)


def test_a_run_that_was_killed_repeatedly_ends_with_the_same_bits(tmp_path, undisturbed):
    for number in (3, 2, 5, 4):  # updates until the kill
        config = config_for(tmp_path, resume=True, save_minutes=1e-9)
        experiment = Experiment(config, progress=False)
        at_call(experiment, experiment.learner, "update", number, kill)
        with pytest.raises(Killed):
            experiment.run()
    assert_same(run(config_for(tmp_path, resume=True)), undisturbed)


@pytest.mark.parametrize(
    "algorithm", [{"name": "dagger"}, {"name": "flow_dagger", "horizon": 3, "executed": 3}]
)
def test_a_run_that_was_killed_counts_each_label_once(tmp_path, algorithm):
    """With chunks, the run is killed while some are executed in part."""
    options = {"algorithm": {"batch_size": 4, **algorithm}, "eval_every": 50}
    whole = run(config_for(tmp_path / "whole", **options))
    assert whole[1]["expert_labels"] == whole[1]["env_steps"] > 0
    assert (whole[1]["demonstrations"], whole[1]["demonstration_steps"] >= 2) == (2, True)
    config = config_for(tmp_path / "run", **options, resume=True, save_minutes=1e-9)
    experiment = Experiment(config, progress=False)
    at_call(experiment, experiment.learner, "update", 11, kill)
    with pytest.raises(Killed):
        experiment.run()
    assert_same(run(config), whole)
    result = read_result(tmp_path / "run")
    assert result.resumed_at == [10]
    assert result.seconds == pytest.approx(sum(result.phase_seconds.values()))


@pytest.mark.parametrize("evaluation", [3, *slow([1, 2])])
def test_a_run_stopped_in_an_evaluation_repeats_it(tmp_path, undisturbed, evaluation):
    experiment = Experiment(config_for(tmp_path), progress=False)
    at_call(experiment, experiment, "_evaluate", evaluation, terminate)
    with pytest.raises(RunStopped):
        experiment.run()
    assert resumable_updates(tmp_path) == 8 * (evaluation - 1)
    assert len(experiment.state.curve) == evaluation - 1
    assert_same(run(config_for(tmp_path, resume=True)), undisturbed)


@pytest.mark.parametrize("number", [1, *slow([2])])
def test_a_run_stopped_in_its_tests_keeps_the_last_state(tmp_path, number, monkeypatch):
    def first_or_last(checkpoints, which):
        newest, *_, oldest = saved_steps(checkpoints._folder / "checkpoints")
        return {"latest": newest, "best": oldest}[which]

    monkeypatch.setattr(Checkpoints, "find", first_or_last)
    whole = run(config_for(tmp_path / "whole"))
    assert whole[1]["best"]["updates"] < whole[1]["last"]["updates"] == 21
    experiment = Experiment(config_for(tmp_path / "run"), progress=False)
    at_call(experiment, experiment, "_test", number, terminate)
    saved = []
    save = experiment._resume_state.save
    experiment._resume_state.save = lambda updates: (saved.append(updates), save(updates))
    with pytest.raises(RunStopped, match="state saved"):
        experiment.run()
    assert saved == [0, 8, 16, 21]
    assert_same(run(config_for(tmp_path / "run", resume=True)), whole)


@pytest.mark.parametrize("number", [5, *slow([1])])
def test_a_run_stopped_before_its_first_update_continues_its_collection(
    tmp_path, undisturbed, number
):
    config = config_for(tmp_path, pretrain_updates=0)
    whole = run(config_for(tmp_path / "whole", pretrain_updates=0))
    experiment = at_call(e := Experiment(config, progress=False), e, "_store", number, terminate)
    with pytest.raises(RunStopped):
        experiment.run()
    assert resumable_updates(tmp_path) == 0
    assert_same(run(config_for(tmp_path, pretrain_updates=0, resume=True)), whole)


@pytest.mark.slow
def test_open_loop_in_worker_processes_continues_with_the_same_bits(tmp_path):
    options = {"base": SDQFD, "parallel": True, "start_method": "fork", "updates_per_step": 1}
    whole = run(config_for(tmp_path / "whole", **options))
    experiment = Experiment(config_for(tmp_path / "run", **options), progress=False)
    at_call(experiment, experiment.learner, "update", 11, terminate)
    with pytest.raises(RunStopped):
        experiment.run()
    assert_same(run(config_for(tmp_path / "run", resume=True, **options)), whole)


def test_repeated_signals_do_not_interrupt_the_save(tmp_path, undisturbed):
    experiment = Experiment(config_for(tmp_path), progress=False)
    at_call(experiment, experiment.learner, "update", 9, terminate)
    at_call(
        experiment, experiment._resume_state, "save", 2, terminate
    )  # the first is at an evaluation
    with pytest.raises(RunStopped, match="state saved"):
        experiment.run()
    assert_same(run(config_for(tmp_path, resume=True)), undisturbed)


def test_a_run_stopped_among_its_demonstrations_has_nothing_to_save(tmp_path, monkeypatch):
    experiment = Experiment(config_for(tmp_path), progress=False)
    monkeypatch.setattr(experiments, "gather_demonstrations", lambda *_: terminate() or _[2](None))
    with pytest.raises(RunStopped, match="nothing to save yet"):
        experiment.run()
    assert resumable_updates(tmp_path) is None


def test_an_error_in_the_collection_saves_the_state(tmp_path, undisturbed):
    experiment = Experiment(config_for(tmp_path), progress=False)

    def fail():
        raise RuntimeError("worker 0 failed 6 times")

    at_call(experiment, experiment, "_store", 13, fail)
    with pytest.raises(RuntimeError, match="worker 0"):
        experiment.run()
    updates = experiment.learner.updates
    assert updates > 2
    assert resumable_updates(tmp_path) == updates
    assert Experiment(config_for(tmp_path, resume=True), progress=False)._resume()


def test_without_the_positions_the_next_episodes_have_other_seeds(tmp_path, monkeypatch):
    experiment = Experiment(config_for(tmp_path), progress=False)

    def fail():
        experiment._collection.env.close()
        raise RuntimeError("all workers were closed")

    at_call(experiment, experiment, "_store", 13, fail)
    with pytest.raises(RuntimeError, match="closed"):
        experiment.run()
    config = config_for(tmp_path, resume=True)
    seeds, make_env = [], collection.make_env

    def recorded(config, seed, **changes):
        seeds.append(seed)
        return make_env(config, seed, **changes)

    monkeypatch.setattr(collection, "make_env", recorded)
    run(config)
    assert config.derived_seed(SeedUse.COLLECTION) not in seeds
    assert config.derived_seed(SeedUse.COLLECTION, resumed_updates(tmp_path)) in seeds


def resumed_updates(folder):
    return read_result(folder).resumed_at[0]


def test_a_failing_update_is_not_saved(tmp_path):
    experiment = Experiment(config_for(tmp_path), progress=False)

    def fail():
        raise FloatingPointError("a loss is not finite")

    at_call(experiment, experiment.learner, "update", 12, fail)
    with pytest.raises(FloatingPointError):
        experiment.run()
    assert resumable_updates(tmp_path) == 8  # of the last evaluation


def test_an_evaluation_draws_nothing_from_the_process_generators(tmp_path):
    experiment = Experiment(config_for(tmp_path), progress=False)
    before = GlobalRNGState().state_dict()
    experiment._evaluate()
    experiment._test()
    assert_same(GlobalRNGState().state_dict(), before)
    experiment.close()


def test_a_running_run_cannot_be_opened_again(tmp_path):
    experiment = Experiment(config_for(tmp_path), progress=False)
    assert run_holder(tmp_path).startswith(f"process {os.getpid()} on ")
    with pytest.raises(ConfigError, match=f"process {os.getpid()} on .* runs the experiment"):
        Experiment(config_for(tmp_path, resume=True), progress=False)
    experiment.close()
    assert run_holder(tmp_path) is None
    Experiment(config_for(tmp_path, resume=True), progress=False).close()
