"""Damaged and poisoned files of runs and demonstrations: none runs code, older states serve."""

import contextlib
import importlib
import json
import os
import pickle
import shutil
import sys

import pytest
import torch

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import CHECKSUMS_FILE, size_and_crc32, write_checksums
from ba_torchrl.demonstrations.demo_files import load_demonstrations, save_demonstrations
from ba_torchrl.record.results import read_failure
from ba_torchrl.training.checkpoint import (
    find_checkpoint,
    load,
    read_config,
    read_versions,
    remove_leftovers,
    resumable_updates,
)
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.experiment import Experiment
from tests.planted import Planted
from tests.tasks import episodes as episodes_of
from tests.training.test_interruption import SAC
from tests.training.test_resume import interrupt

TASK, ENV = "close_loop/block_reaching", {"obs_size": 64, "max_steps": 8}
TINY = {
    **SAC,
    "env": ENV,
    "algorithm": {**SAC["algorithm"], "replay": {"name": "prioritized", "capacity": 50}},
    "num_envs": 1,
    "demonstrations": 1,
    "pretrain_updates": 0,
    "total_updates": 9,
    "updates_per_step": 1,
    "min_replay": 2,
    "eval_every": 2,
    "eval_episodes": 1,
    "final_eval_episodes": 1,
}
SIDECARS = ("other.pickle", "pickle.pkl", "prefetch.pkl", "state.pt", "transform.t", "frames.pt")


def config_for(folder, **changes):
    return ExperimentConfig.parse({**TINY, "run_dir": str(folder), **changes})


@pytest.fixture(scope="module")
def interrupted_run(tmp_path_factory):
    """A run folder with the states after 2 and 4 updates."""
    folder = tmp_path_factory.mktemp("interrupted") / "run"
    interrupt(config_for(folder), after=5)
    return folder


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory):
    episodes = episodes_of.demonstrations(TASK, 2, env=ENV)
    path = tmp_path_factory.mktemp("demos") / "demos"
    save_demonstrations(path, episodes, task=TASK, env=ENV, seed=0)
    return path


@pytest.fixture
def run(interrupted_run, tmp_path):
    return shutil.copytree(interrupted_run, tmp_path / "run")


def resume(folder):
    experiment = Experiment(config_for(folder, resume=True), progress=False)
    try:
        experiment._resume()
    finally:
        experiment.close()
    return experiment


def reseal(folder):
    """Write checksums of every file, as somebody does who plants one."""
    files = {
        path.relative_to(folder).as_posix(): size_and_crc32(path)
        for path in folder.rglob("*")
        if path.is_file() and path.name != CHECKSUMS_FILE
    }
    (folder / CHECKSUMS_FILE).write_text(json.dumps({"crc32": files}))


def representatives(folder):
    """Return the files of a folder, one of those that differ only in their number."""
    chosen = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            name = "".join(c for c in path.relative_to(folder).as_posix() if not c.isdigit())
            chosen.setdefault(name, path.relative_to(folder))
    return list(chosen.values())


def plant_everywhere(folder, payload):
    """Yield once for each file of a sealed folder that is replaced or added, then undo it."""
    for name in representatives(folder):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(payload)
        if name.name != CHECKSUMS_FILE:
            reseal(folder)
        yield str(name)
        (folder / name).write_bytes(content)
    for parent in [folder, *(path for path in sorted(folder.rglob("*")) if path.is_dir())]:
        for name in SIDECARS:
            (parent / name).write_bytes(payload)
        reseal(folder)
        yield f"{parent.relative_to(folder)}/*.pickle"
        for name in SIDECARS:
            (parent / name).unlink()
    reseal(folder)


def assert_no_file_runs(folder, open_folder, tmp_path):
    trace = tmp_path / "trace"
    planted = Planted(trace)
    pickle.loads(pickle.dumps(planted))
    trace.rmdir()  # the payload works
    torch_file = tmp_path / "planted.pt"
    torch.save(planted, torch_file)
    count = 0
    for payload in (pickle.dumps(planted), torch_file.read_bytes()):
        for name in plant_everywhere(folder, payload):
            with contextlib.suppress(ConfigError):  # a replaced tensor may be read, as numbers
                open_folder()
            assert not trace.exists(), name
            count += 1
    assert count >= 10
    open_folder()


def test_no_file_of_a_checkpoint_runs_code(run, tmp_path):
    checkpoint = find_checkpoint(run, "latest")
    assert_no_file_runs(checkpoint, lambda: load(checkpoint), tmp_path)


def test_no_file_of_demonstrations_runs_code(demonstrations, tmp_path):
    folder = shutil.copytree(demonstrations, tmp_path / "demos")
    assert_no_file_runs(folder, lambda: load_demonstrations(folder, task=TASK, env=ENV), tmp_path)


@pytest.mark.parametrize("name", ["task_version", "expert_version"])
def test_a_run_without_one_of_its_versions_says_what_to_do(tmp_path, name):
    saved = {"task_version": 0, "expert_version": 0}
    (tmp_path / "config.json").write_text(json.dumps(saved))
    assert read_versions(tmp_path) == (0, 0)
    del saved[name]
    (tmp_path / "config.json").write_text(json.dumps(saved))
    with pytest.raises(ConfigError, match=r"has no task_version and expert_version; train again"):
        read_versions(tmp_path)


def test_no_module_that_a_run_names_is_imported(run, monkeypatch):
    (run / "planted_module.py").write_text("raise AssertionError('imported')")
    monkeypatch.syspath_prepend(run)
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**config, "plugins": ["planted_module"]}))
    for opened in (read_config, load):
        with pytest.raises(ConfigError, match=r"the plugins \[planted_module\]: .* add 'plugins"):
            opened(run)
    with pytest.raises(ConfigError, match="planted_module"):
        Experiment(config_for(run, resume=True), progress=False)
    (run / "planted_module.py").write_text("")
    importlib.import_module("planted_module")  # by the user
    assert read_config(run).plugins == ["planted_module"]
    del sys.modules["planted_module"]


# -- damage ------------------------------------------------------------------------------------


def cut(path):
    os.truncate(path, path.stat().st_size // 2)


def flip(path):
    content = bytearray(path.read_bytes())
    for place in range(0, 64):
        content[place * len(content) // 64] ^= 0xFF
    path.write_bytes(content)


def largest(folder):
    return max(folder.rglob("*.safetensors"), key=lambda path: path.stat().st_size)


@pytest.mark.parametrize("damage", [cut, flip])
def test_a_damaged_state_falls_back_to_the_one_before(run, damage, caplog):
    assert resumable_updates(run) == 4
    damage(largest(max((run / "resume").iterdir())))
    experiment = resume(run)
    assert experiment.learner.updates == 2
    assert "passed over for the one before" in caplog.text
    assert len(list((run / "resume").iterdir())) == 1  # the damaged one is deleted


def test_a_run_whose_states_are_all_damaged_says_what_to_do(run):
    for state in (run / "resume").iterdir():
        cut(largest(state))
    with pytest.raises(ConfigError, match="start the run again in another run_dir") as error:
        resume(run)
    assert "\n" not in str(error.value)
    for checkpoint in (run / "checkpoints").iterdir():
        cut(checkpoint / "manifest.json")
    with pytest.raises(ConfigError, match="all checkpoints"):
        load(run)


@pytest.mark.parametrize("which", ["latest", "best"])
@pytest.mark.parametrize("damage", [cut, flip])
def test_a_damaged_checkpoint_falls_back_to_the_one_before(run, which, damage, caplog):
    newest = find_checkpoint(run, which)  # of equal ones the newest is the best
    damage(largest(newest))
    older = find_checkpoint(run, which)
    assert older != newest
    assert newest.name in caplog.text
    assert load(run, which)[1].updates == int(older.name[-1])
    with pytest.raises(ConfigError, match=str(newest)):  # asked for by name
        load(newest)


def test_damaged_demonstrations_are_refused(demonstrations, tmp_path):
    folder = shutil.copytree(demonstrations, tmp_path / "demos")
    flip(largest(folder))
    with pytest.raises(ConfigError, match="its checksum differs"):
        load_demonstrations(folder, task=TASK, env=ENV)


def test_files_nested_without_end_are_damaged(tmp_path):
    for name in ("config.json", "failure.json", "demonstrations.json"):
        (tmp_path / name).write_text("[" * 200_000)
    assert read_failure(tmp_path) == "failure.json is damaged"
    with pytest.raises(ConfigError, match="cannot read"):
        read_config(tmp_path)
    with pytest.raises(ConfigError, match="no demonstrations at"):
        load_demonstrations(tmp_path, task=TASK, env=ENV)


@pytest.mark.parametrize("content", ["null", "[]", '"text"', "1", "{}"])
def test_a_sealed_manifest_of_another_form_is_refused(run, content):
    checkpoint = find_checkpoint(run, "latest")
    (checkpoint / "manifest.json").write_text(content)
    write_checksums(checkpoint)
    with pytest.raises(ConfigError, match="does not fit this version"):
        load(run)


@pytest.mark.parametrize(
    ("adapter", "message"),
    [
        ("ba_torchrl.state", "does not fit this version"),  # kernels of other signs
        ("ba_torchrl.state.2", "does not fit .*: the image with the key pixels .*; train again"),
    ],
)
def test_a_checkpoint_of_another_version_is_refused(run, adapter, message):
    manifest = find_checkpoint(run, "latest") / "manifest.json"
    text = manifest.read_text()
    assert '"ba_torchrl.state.3"' in text
    manifest.write_text(text.replace("ba_torchrl.state.3", adapter))
    write_checksums(manifest.parent)
    with pytest.raises(ConfigError, match=message):
        load(run, "latest")


@pytest.mark.parametrize("part", ["resume", "checkpoints"])
def test_a_state_that_was_about_to_be_replaced_gets_its_name_back(run, part):
    newest = max((run / part).glob("checkpoint-*"))
    newest.rename(newest.with_name(f".{newest.name}.old"))
    older = newest.with_name(".checkpoint-000000000001.old")
    shutil.copytree(min((run / part).glob("checkpoint-*")), older)
    remove_leftovers(run / part)
    assert newest.exists()
    assert not list((run / part).glob(".checkpoint-*"))


def test_leftovers_of_an_interrupted_save_are_removed(run):
    for part in ("resume", "checkpoints"):
        newest = max((run / part).iterdir())
        shutil.copytree(newest, newest.with_name(f".{newest.name}.scratch"))
        newest.with_name(f".{newest.name}.lock").touch()
    resume(run)
    for part in ("resume", "checkpoints"):
        assert not list((run / part).glob(".*"))
