"""Errors of configuration and of resources: one clear line, before work starts."""

import errno
import math
import os
import shutil
from collections import namedtuple

import pytest
import torch
from omegaconf import OmegaConf

import ba_torchrl
from ba_torchrl.data.state_files import write_state
from ba_torchrl.errors import ConfigError
from ba_torchrl.training.command_line import EXIT_CODE, check_writable, mapping_of, plain_errors
from ba_torchrl.training.config import ExperimentConfig
from tests.recipes import recipe

RUN = {
    "task": "close_loop/block_reaching",
    "algorithm": {"name": "sac"},
    "network": {"name": "cnn"},
}


COUNTS = [
    (name, f"{field}={value}", field)
    for name, fields in {
        "collect_demos": ("episodes", "num_envs"),
        "experts": ("episodes", "num_envs"),
        "play": ("episodes",),
        "evaluate": ("episodes", "num_envs", "video_episodes"),
    }.items()
    for field in fields
    for value in ("0", "-3", "1.5", "many", "true")
]


SEEDS = [
    (name, f"seed={value}", "seed: must be a whole number from 0 to 9223372036854775807")
    for name in ("collect_demos", "experts", "play", "evaluate", "soak", "gallery")
    for value in ("-1", "0.5", "many", str(2**63))
]


@pytest.mark.parametrize(
    ("name", "override", "words"),
    [
        *COUNTS,
        *SEEDS,
        ("collect_demos", "replays=-1", "replays"),
        ("collect_demos", "plugins=3", "plugins: must be a list of names of modules"),
        ("collect_demos", "plugins=['']", "plugins: '' is not the name of a module"),
        ("collect_demos", "plugins=[no_such_module]", "cannot import the plugin 'no_such_module'"),
        ("collect_demos", "path=null", "path: must be text"),
        ("experts", "tasks=3", "tasks: must be a list of names"),
        ("soak", "folder=null", "folder: must be text"),
        ("soak", "steps=1", "steps: must be a whole number of at least 10"),
        ("soak", "tasks=[mine/none]", "unknown task 'mine/none'"),
        ("experts", "robots=[kuka,baxter]", "unknown robot 'baxter'"),
        ("experts", "path=/proc/nowhere/table.md", "cannot write to /proc/nowhere"),
        ("collect_demos", "path=/proc/nowhere/demos", "cannot write to /proc/nowhere"),
        ("play", "video=/proc/nowhere/play.mp4", "cannot write to /proc/nowhere"),
        ("play", "video=play.avi", "a video ends in .mp4 or .gif"),
        ("play", "fps=0", "fps must be positive"),
        ("play", "fps=fast", "fps must be positive"),
        ("evaluate", "video=evaluation.mov", "a video ends in .mp4 or .gif"),
    ],
)
def test_recipes_refuse_what_they_cannot_do_before_they_start(
    name, override, words, capsys, monkeypatch, tmp_path
):
    def started(*_, **__):
        raise AssertionError("work started")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ba_torchrl.envs.factory.make_env", started)
    required = ["checkpoint=run"] if name == "evaluate" else []
    with pytest.raises(SystemExit) as end:
        recipe(name, *required, override)
    error = capsys.readouterr().err
    assert end.value.code == EXIT_CODE
    assert words in error
    assert error.count("\n") == 1
    assert "Traceback" not in error


@pytest.mark.parametrize("name", ["train", "collect_demos", "benchmark"])
def test_an_unknown_plugin_on_the_command_line_is_one_line(name, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", [name, "plugins=[no_such_module]"])
    with pytest.raises(SystemExit) as end:
        recipe(name)
    error = capsys.readouterr().err
    assert end.value.code == EXIT_CODE
    assert error.startswith("error: cannot import the plugin 'no_such_module': there is no module")
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"min_replay": 100_001}, "min_replay: 100001 transitions are more than the replay holds"),
        ({"algorithm": {"name": "sac", "learning_rate": math.inf}}, "learning_rate"),
        ({"algorithm": {"name": "sac", "learning_rate": math.nan}}, "learning_rate"),
        ({"env": {"dpos": 1e30}}, "dpos"),
        ({"env": {"drot": 1e30}}, "drot"),
        ({"env": {"dpos": math.inf}}, "dpos"),
        ({"env": {"view_scale": 1e30}}, "view_scale"),
        ({"num_envs": 3000}, "num_envs"),
        ({"run_dir": ""}, "run_dir"),
        ({"seed": 2**63}, "seed"),
        ({"device": "meta"}, "device: use device=cpu"),
        ({"timeout_s": 0.0}, "timeout_s"),
        ({"max_restarts": -1}, "max_restarts"),
        ({"save_minutes": math.inf}, "save_minutes"),
    ],
)
def test_a_run_that_cannot_work_is_refused(changes, words):
    with pytest.raises(ConfigError, match=words):
        ExperimentConfig.parse({**RUN, **changes})


def test_a_symmetric_replay_holds_both_halves():
    algorithm = {"name": "sac", "replay": "symmetric", "buffer_size": 50}
    ExperimentConfig.parse({**RUN, "algorithm": algorithm, "min_replay": 100})
    with pytest.raises(ConfigError, match=r"holds \(100\)"):
        ExperimentConfig.parse({**RUN, "algorithm": algorithm, "min_replay": 101})


def test_too_many_environments_are_refused():
    with pytest.raises(ConfigError, match="num_envs: at most 1024"):
        ba_torchrl.make_vector_env("close_loop/block_reaching", 3000)


Usage = namedtuple("Usage", "total used free")


def test_a_small_shared_memory_is_refused(monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(1000, 500, 500))
    with pytest.raises(ConfigError, match="lower num_envs, or enlarge it"):
        ba_torchrl.make_vector_env("close_loop/block_reaching", 2, start_method="fork")


def test_too_few_file_handles_are_refused(monkeypatch):
    def fail(*_, **__):
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr("ba_torchrl.envs.vector.parallel.Worker", fail)
    with pytest.raises(ConfigError, match=r"Too many open files.*ulimit -n"):
        ba_torchrl.make_vector_env("close_loop/block_reaching", 2, start_method="fork")


def test_a_full_disk_is_noticed_before_anything_is_written(monkeypatch, tmp_path):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**9, 10**9, 10**7))
    write_state(tmp_path / "small", {"step": 1})
    with pytest.raises(OSError, match="MB are free") as error:
        write_state(tmp_path / "large", {"part": [torch.zeros(2_600_000)]})
    assert error.value.errno == errno.ENOSPC
    assert not (tmp_path / "large").exists()


def test_errors_of_resources_are_one_line(capsys):
    @plain_errors
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(SystemExit):
        full(None)
    assert capsys.readouterr().err == "error: [Errno 28] No space left on device\n"

    @plain_errors
    def broken(_):
        raise OSError(errno.EINVAL, "a defect")

    with pytest.raises(OSError, match="a defect"):
        broken(None)


@pytest.mark.skipif(os.geteuid() == 0, reason="root can write everywhere")
def test_a_folder_without_permission_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(ConfigError, match="Permission denied"):
        check_writable(tmp_path / "file")


@pytest.mark.parametrize("value", [None, 1, "text", ["a"]])
def test_a_group_of_settings_must_be_one(value):
    assert mapping_of(OmegaConf.create({"env": {"robot": "ur5"}}), "env") == {"robot": "ur5"}
    with pytest.raises(ConfigError, match="env: must be a group of settings, got"):
        mapping_of(OmegaConf.create({"env": value}), "env")
