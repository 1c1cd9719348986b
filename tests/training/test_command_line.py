"""Errors of configuration and of resources: one clear line, before work starts."""

import errno
import json
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
from ba_torchrl.training.command_line import (
    EXIT_CODE,
    check_writable_file,
    mapping_of,
    plain_errors,
)
from ba_torchrl.training.config import ExperimentConfig
from tests.recipes import load_recipe, recipe

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


FLAGS = [
    (name, f"{field}={value}", f"{field}: must be true or false")
    for name, field in (
        ("benchmark", "dry_run"),
        ("collect_demos", "only_successful"),
        ("evaluate", "expert"),
        ("speed", "profile"),
    )
    for value in ("maybe", "null", "1")
] + [
    (name, f"parallel={value}", "parallel: must be true, false or null")
    for name in ("collect_demos", "evaluate", "experts")
    for value in ("maybe", "1")
]


LONG = 300 * "n"
UNKNOWN = [
    *(
        (name, "+foo=1", "unknown setting 'foo'. Known: ")
        for name in (
            "collect_demos",
            "evaluate",
            "gallery",
            "play",
            "plot",
            "report",
            "soak",
            "speed",
            "tasks",
        )
    ),
    ("experts", "+env.num_objects=3", "unknown setting 'env'. Known: episodes, num_envs"),
]
UNWRITABLE = [
    (name, f"{field}={path}", "cannot write to ")
    for name, fields, suffix in (
        ("train", ("run_dir",), ""),
        ("benchmark", ("folder",), ""),
        ("soak", ("folder",), ""),
        ("gallery", ("folder",), ""),
        ("report", ("folder",), ""),
        ("gallery", ("overview",), ".png"),
        ("plot", ("path",), ".png"),
        ("play", ("video",), ".mp4"),
        ("evaluate", ("video",), ".mp4"),
        ("speed", ("output",), ".json"),
        ("collect_demos", ("path",), ""),
        ("experts", ("path",), ""),
        ("tasks", ("path",), ""),
    )
    for field in fields
    for path in (
        *((f"folder{suffix}",) if suffix else ()),
        f"file/x{suffix}",
        f"/proc/nope/x{suffix}",
        f"/dev/full/x{suffix}",
        f"{LONG}{suffix}",
    )
    if not (name == "report" and field == "folder")
]
UNWRITABLE += [
    ("train", "run_dir=file", "it is not a folder"),
    ("train", "run_dir=/dev/full", "it is not a folder"),
    ("benchmark", "folder=file", "it is not a folder"),
    ("gallery", "folder=file", "it is not a folder"),
    ("experts", "path=run", "it is a folder"),
    ("tasks", "path=run", "it is a folder"),
]
"""In a folder with a file called "file", and folders called "run" and "folder" with suffixes."""


REFUSED = [
    ("train", "threads=100000", "threads: Input should be less than or equal to 1024"),
    ("train", "algorithm.learning_rate=1e300", "learning_rate: Input should be less than"),
    ("benchmark", "only=9999", "only: must be a number from 0 to "),
    ("benchmark", "only=abc", "only: must be a whole number"),
    ("benchmark", "only=-5", "only: must be a whole number"),
    ("benchmark", "seeds=100000000000", "seeds"),
    ("collect_demos", "+env.seed=5", "env.seed is set by the recipe; leave it out, and set seed"),
    ("collect_demos", "+env.expert=false", "leave it out, and set source"),
    ("collect_demos", "path=run", "run exists already"),
    ("collect_demos", "num_envs=3000", "num_envs: must be a whole number from 1 to 1024"),
    ("play", "+env.seed=5", "leave it out, and set seed"),
    ("play", "+env.expert=true", "leave it out, and set policy"),
    ("play", "fps=1e-9", "fps must be a number from 1 to 240"),
    ("play", "fps=1000", "fps must be a number from 1 to 240"),
    ("soak", "+env.seed=3", "leave it out, and set seed"),
    ("soak", "+env.expert=false", "env.expert is set by the recipe"),
    ("soak", "tasks=[]", "tasks: the list is empty"),
    ("evaluate", "num_envs=3000", "num_envs: must be a whole number from 1 to 1024"),
    ("experts", "num_envs=3000", "num_envs: must be a whole number from 1 to 1024"),
    ("experts", "tasks=[]", "tasks: the list is empty"),
    ("experts", "tasks=[close_loop/none]", "unknown task 'close_loop/none'"),
    ("experts", "robots=[]", "robots: the list is empty"),
    ("experts", "variants.close_loop=3", "variants.close_loop: must be a group of columns"),
    ("experts", "variants.close_loop=null", "variants.close_loop: must be a group of columns"),
    ("experts", "+variants.open_loop.x=3", "variants.open_loop.x: must be a group of settings"),
    ("experts", "+variants.open_loop.x={seed: 3}", "variants.open_loop.x.seed: leave it out"),
    ("gallery", "tasks=3", "tasks: must be a list of names"),
    ("gallery", "tasks=[]", "tasks: the list is empty"),
    ("gallery", "deconstructions=[open_loop/bin_packing]", "deconstruction has no meaning"),
    ("gallery", "pictures=-1", "pictures: must be a whole number"),
    ("gallery", "pictures=abc", "pictures: must be a whole number"),
    ("gallery", "overview=all.nope", "ends in .png, not all.nope"),
    ("tasks", "tasks=3", "tasks: must be a list of names"),
    ("tasks", "tasks=[]", "tasks: the list is empty"),
    ("plot", "runs=5", "runs: must be a folder or a list of folders"),
    ("plot", "runs=[]", "runs: must be a folder or a list of folders"),
    ("plot", "runs=[nope]", "runs: there is no folder nope"),
    ("plot", "runs=[run]", "cannot read the scalars of run"),
    ("plot", "path=x.nope", "ends in .png, not x.nope"),
    ("plot", "title=null", "title: must be text"),
    ("report", "runs=nope", "runs: there is no folder nope"),
    ("report", "runs=[]", "runs: must be a folder or a list of folders"),
    ("report", "runs=5", "runs: must be a folder or a list of folders"),
    ("report", "runs=null", "runs: must be a folder or a list of folders"),
    ("report", "runs=run", "no finished run below run"),
]
REQUIRED = {
    "train": ("label=a", "run_dir=new"),
    "benchmark": ("name=a", "folder=new"),
    "evaluate": ("checkpoint=run",),
    "plot": ("runs=[run]",),
    "report": ("runs=run",),
}


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
        ("play", "fps=0", "fps must be a number from 1 to 240"),
        ("play", "fps=fast", "fps must be a number from 1 to 240"),
        ("evaluate", "video=evaluation.mov", "a video ends in .mp4 or .gif"),
        ("collect_demos", "turn_noise=2", "turn_noise: must be at least 0 and less than 1, got 2"),
        *FLAGS,
        *UNKNOWN,
        *UNWRITABLE,
        *REFUSED,
    ],
)
def test_recipes_refuse_what_they_cannot_do_before_they_start(
    name, override, words, capsys, monkeypatch, tmp_path
):
    def started(*_, **__):
        raise AssertionError("work started")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ba_torchrl.envs.factory.make_env", started)
    monkeypatch.setattr("ba_torchrl.make", started)
    monkeypatch.setattr("ba_torchrl.training.experiment.Experiment.run", started)
    monkeypatch.setattr("ba_torchrl.training.grid.launchers.local.run_all", started)
    (tmp_path / "file").write_text("a file")
    (tmp_path / "folder.mp4").mkdir()
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "run").mkdir()
    (tmp_path / "run/config.json").write_text(json.dumps(RUN))
    (tmp_path / "run/scalars.csv").write_text("step,name,value\n5,torn\n")
    with pytest.raises(SystemExit) as end:
        recipe(name, *REQUIRED.get(name, ()), override)
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


def test_collection_alone_must_reach_the_least_size_of_a_symmetric_replay():
    """Without demonstrations, one of its halves stays empty."""
    algorithm = {"name": "sac", "replay": "symmetric", "buffer_size": 50}
    ExperimentConfig.parse({**RUN, "algorithm": algorithm, "min_replay": 50})
    with pytest.raises(ConfigError, match=r"than the replay holds \(50\)"):
        ExperimentConfig.parse({**RUN, "algorithm": algorithm, "min_replay": 51})


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


def test_an_interruption_outside_of_a_run_is_one_line(capsys):
    @plain_errors
    def main(settings):
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as end:
        main(None)
    assert end.value.code == 130
    assert capsys.readouterr().err == "stopped by SIGINT\n"


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


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 7 TiB"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to\nallocate 7 TiB"),
        torch.OutOfMemoryError("CUDA out of memory"),
    ],
)
def test_a_lack_of_memory_is_one_line(error, capsys):
    @plain_errors
    def large(_):
        raise error

    with pytest.raises(SystemExit):
        large(None)
    line = capsys.readouterr().err
    assert line.startswith("error: out of memory: ")
    assert line.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--compare", "missing"], "cannot read missing: No such file"),
        (["--compare", "torn"], "torn is not a record"),
        (["--compare", "deep"], "deep is not a record"),
        (["--compare", "foreign"], "foreign is not a record: parts: Field required"),
        (["--out", "torn/x"], "cannot write to torn"),
        (["--out", "record.json", "--workers", "0"], "--workers must be at least 1"),
    ],
)
def test_fingerprint_refuses_what_it_cannot_do(arguments, words, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "torn").write_text('{"parts": ["envs"')
    (tmp_path / "deep").write_text(200_000 * "[")
    (tmp_path / "foreign").write_text('{"rows": []}')
    with pytest.raises(SystemExit) as end:
        load_recipe("fingerprint").main(arguments)
    assert end.value.code == EXIT_CODE
    assert words in capsys.readouterr().err


@pytest.mark.skipif(os.geteuid() == 0, reason="root can write everywhere")
def test_a_folder_without_permission_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(ConfigError, match="Permission denied"):
        check_writable_file(tmp_path / "file")


@pytest.mark.parametrize("value", [None, 1, "text", ["a"]])
def test_a_group_of_settings_must_be_one(value):
    assert mapping_of(OmegaConf.create({"env": {"robot": "ur5"}}), "env") == {"robot": "ur5"}
    with pytest.raises(ConfigError, match="env: must be a group of settings, got"):
        mapping_of(OmegaConf.create({"env": value}), "env")
