"""Errors of configuration and of resources: one clear line, before work starts."""

import errno
import importlib
import json
import os
import pkgutil
import re
import shutil
from collections import namedtuple
from pathlib import Path
from typing import get_args, get_origin

import pytest
import torch
from pydantic import create_model

import ba_torchrl
from ba_torchrl.cli import EXIT_CODE, types
from ba_torchrl.cli.errors import plain_errors
from ba_torchrl.cli.types import check_writable_file
from ba_torchrl.core.config import StrictModel, descriptions, expanded, parse
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import atomic_output
from tests.recipes import load_recipe, recipe

RUN = {
    "task": "close_loop/block_reaching",
    "algorithm": {"name": "sac"},
    "network": {"name": "cnn"},
}
LONG = 300 * "n"
REFUSED = [
    ("train", "run_dir=file", "is not a folder"),
    ("train", "run_dir=/dev/full/x", "cannot write to "),
    ("train", "demonstrations_source=deconstruction", "deconstruction has no meaning for close_lo"),
    ("benchmark", "only=9999", "only: must be a number from 0 to "),
    ("benchmark", "folder=file", "is not a folder"),
    ("collect", "source=deconstruction noise=0.1 task=open_loop/house_building_1", "no random a"),
    ("collect", "turn_noise=0.1 env.action_sequence=pxyz", "the actions have no turns"),
    ("collect", "foo=1", "unknown setting 'foo'. Known: "),
    ("collect", "env.seed=5", "env: seed is set by the command; leave it out, and set seed"),
    ("collect", "source=deconstruction", "deconstruction has no meaning for close_loop/block_pick"),
    ("collect", "path=run", "run exists already"),
    ("collect", "path=held", "writes held; choose another path"),
    ("collect", "task=close_loop/block_pulling", "demos/close_loop_block_pulling exists already"),
    ("collect", "plugins=[no_such_module]", "cannot import the plugin 'no_such_module'"),
    ("collect", "plugins=[json.py]", "there is no module 'json.py'. Leave out '.py', run from"),
    ("play", "video=new/x.gif episodes=0", "episodes: must be at least 1"),
    ("play", "close_loop/block_picking video=new/x.gif env.obs_sice=64", "unknown parameter"),
    ("play", "policy=nowhere video=new/x.gif", "unknown policy 'nowhere'"),
    ("evaluate", "video=new/x.mp4 video_episodes=0", "video_episodes: must be at least 1"),
    ("evaluate", "result=new/x", "result is for policies of LeRobot"),
    ("convert", "demos format=minari path=new/x", "demos"),
    ("graded", "close_loop/block_reaching path=new env.obs_sice=64", "unknown parameter"),
    ("teleoperate", "open_loop/block_stacking path=new/x", "poses, record its expert"),
    ("evaluate", "env.obs_size=128", "unknown setting 'env'. Known: plugins, num_envs, "),
    ("diagnose", "folder=run", "run exists already; choose another path"),
    ("experts", "env.num_envs=3", "unknown parameter 'num_envs'"),
    ("experts", "env.robot=ur5", "env: robot is set by the command; leave it out, and set robots"),
    ("experts", "env.action_sequence=pxy", "leave it out, and read the column that it names"),
    ("experts", "path=new/x env.obs_sice=64", "unknown parameter"),
    ("experts", "path=file", "file exists already; choose another path"),
    ("experts", "robots=[kuka,baxter]", "unknown robot 'baxter'"),
    ("gallery", "deconstructions=[open_loop/bin_packing]", "deconstruction has no meaning"),
    ("plot", "runs=[run]", "cannot read the scalars of run"),
    ("tasks", "path=new/x tasks=[close_loop/none]", "unknown task"),
    ("tasks", "path=file", "file exists already; choose another path"),
    ("export", "path=new/x.safetensors episodes=0", "episodes: must be at least 1"),
    ("export", "path=file", "file exists already; choose another path"),
    ("gallery", "folder=pictures", "pictures/close_loop_block_reaching.png exists already"),
    ("leaderboard", "runs=demos", "no run below demos"),
    ("report", "folder=new runs=demos", "no finished run below demos"),
    ("diagnose", "folder=new/x pictures=-1", "pictures: must be at least 0"),
    ("soak", "folder=new/x env.obs_sice=64", "unknown parameter"),
    ("gallery", "folder=new tasks=[close_loop/none]", "unknown task"),
    ("report", "folder=file/x", "cannot write to "),
    ("measure", "output=folder.json", "cannot write to "),
]
REQUIRED = {
    "train": ("run_dir=new",),
    "benchmark": ("folder=new", f"tasks=[{RUN['task']}]", "algorithms=[sac]", "networks=[cnn]"),
    "evaluate": ("policy=run",),
    "diagnose": ("policy=run",),
    "export": ("policy=run",),
    "plot": ("runs=[run]",),
    "report": ("runs=run",),
}


@pytest.mark.parametrize(("name", "override", "words"), REFUSED)
def test_recipes_refuse_what_they_cannot_do_before_they_start(
    name, override, words, capsys, monkeypatch, tmp_path
):
    def started(*_, **__):
        raise AssertionError("work started")

    load_recipe(name)  # else modules that are imported later would keep `started`
    for module in ("envs.gym", "testing.tasks", "training.evaluation", "training.policy"):
        importlib.import_module(f"ba_torchrl.{module}")
    monkeypatch.chdir(tmp_path)
    # in this order: each looks up what the next one replaces
    monkeypatch.setattr("ba_torchrl.make", started)
    monkeypatch.setattr("ba_torchrl.envs.factory.make", started)
    monkeypatch.setattr("ba_torchrl.training.experiment.Experiment.run", started)
    monkeypatch.setattr("ba_torchrl.training.grid.launchers.local.run_all", started)
    (tmp_path / "file").write_text("a file")
    (tmp_path / "folder.mp4").mkdir()
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "demos/close_loop_block_pulling").mkdir(parents=True)
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures/close_loop_block_reaching.png").touch()
    (tmp_path / "run").mkdir()
    (tmp_path / "run/config.json").write_text(json.dumps(RUN))
    (tmp_path / "run/scalars.csv").write_text("step,name,value\n5,torn\n")
    required = [word for word in REQUIRED.get(name, ()) if f"{word.split('=')[0]}=" not in override]
    with atomic_output(tmp_path / "held"):
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(SystemExit) as end:
            recipe(name, *required, *override.split())
        assert sorted(tmp_path.rglob("*")) == before  # nothing is left of it
    error = capsys.readouterr().err
    assert end.value.code == EXIT_CODE
    assert words in error
    assert error.count("\n") == 1
    assert "Traceback" not in error


def test_play_says_whether_each_episode_succeeded(capsys):
    for policy, said in (("expert", "success after "), ("random", "failure after 1 step\n")):
        words = (f"policy={policy}", "env.max_steps=" + ("1" if policy == "random" else "50"))
        recipe("play", "close_loop/block_reaching", *words, "episodes=2", "video=null")
        lines = capsys.readouterr().out
        for number in (1, 2):
            assert f"episode {number}: {said}" in lines


@pytest.mark.parametrize(
    ("kind", "right", "wrong"),
    [
        ("Plugins", ["json"], ["json", [""], ["no_such_module"], 3]),
        ("Tasks", None, [3, [], ["close_loop/none"], [1]]),
        ("Folders", "run", ["nope", [], ["nope"], 5, None, [1], LONG, ["~no one/run"]]),
        ("OutputFolder", "new", ["file", "file/x", "/proc/nope/x", "/dev/full/x", LONG, "a\0b"]),
        ("NewPath", "new.md", ["run", "file", "link", "file/x", "/dev/full/x", LONG]),
        ("PngFile", "new.png", ["new.nope", "file/x.png", "folder.png"]),
        ("VideoFile", "new.GIF", ["new.avi", "/dev/full/x.mp4"]),
    ],
)
def test_types_of_settings(kind, right, wrong, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("a file")
    (tmp_path / "link").symlink_to("nowhere")
    for name in ("run", "folder.png"):
        (tmp_path / name).mkdir()
    model = create_model("Settings", __base__=StrictModel, value=(getattr(types, kind), ...))
    parse(model, {"value": right}, "settings")
    for value in wrong:
        with pytest.raises(ConfigError, match=r"^invalid settings:\n  value"):
            parse(model, {"value": value}, "settings")


NO_PATHS = {
    *("EntrySource.source", "RunResult.policy_file"),
    *("BenchmarkConfig.algorithms", "BenchmarkConfig.networks"),
}
"""Fields whose descriptions speak of files: names in them, names of presets, checksums."""


def models(base):
    for model in base.__subclasses__():
        yield model
        yield from models(model)


def _owner(model, field):
    """The class that declares a field."""
    return [each for each in model.__mro__ if field in vars(each).get("__annotations__", ())][-1]


def has_text(annotation):
    """Whether a value can be a text, a path, or a list of them."""
    is_mapping = get_origin(annotation) is dict
    parts = () if is_mapping else get_args(annotation)
    return annotation in (str, Path) or any(map(has_text, parts))


def takes_path(field):
    """Whether a field is a path, or has paths."""

    def mentions(annotation):
        is_path = getattr(annotation, "func", None) is expanded
        return is_path or any(map(mentions, get_args(annotation)))

    return any(map(mentions, [*field.metadata, field.annotation]))


def test_every_path_among_the_settings_has_the_type_of_paths():
    for module in pkgutil.walk_packages(ba_torchrl.__path__, "ba_torchrl."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    recipes = [load_recipe(name).Settings for name in ("gallery", "measure", "plot", "soak")]
    ours = [model for model in models(StrictModel) if model.__module__.startswith("ba_torchrl.")]
    found, others = set(), set()
    for model in {*ours, *recipes}:
        texts = descriptions(model)
        for name, field in model.model_fields.items():
            words = f"{name} {texts.get(name)}".lower()
            speaks = re.search(r"\b(file|folder|path)s?\b|path|_dir|root|folder|mapping", words)
            if takes_path(field):
                found.add(name)
            elif has_text(field.annotation) and (speaks or field.annotation is Path):
                others.add(f"{_owner(model, name).__name__}.{name}")
    assert others == NO_PATHS
    assert {"run_dir", "demonstrations_path", "asset_root", "runs", "policy", "video"} <= found


def test_too_many_environments_are_refused():
    with pytest.raises(ConfigError, match="num_envs: at most 1024"):
        ba_torchrl.make_vector_env("close_loop/block_reaching", 3000)


Usage = namedtuple("Usage", "total used free")


def test_a_small_shared_memory_is_refused(monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(1000, 500, 500))
    with pytest.raises(ConfigError, match="lower num_envs, or enlarge it"):
        ba_torchrl.make_vector_env("close_loop/block_reaching", 2, start_method="fork")


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (KeyboardInterrupt(), "stopped by SIGINT\n"),
        (OSError(errno.ENOSPC, "No space left"), "error: [Errno 28] No space left\n"),
        (OSError(errno.ENOTDIR, "Not a directory"), "error: [Errno 20] Not a directory\n"),
        (RuntimeError("x.safetensors: Too many open files (24)"), "error: [Errno 24] Too many "),
        (MemoryError("Unable to allocate 7 TiB"), "error: out of memory: Unable to"),
        (RuntimeError("can't allocate memory: you tried to\nallocate"), "error: out of memory: "),
        (torch.OutOfMemoryError("CUDA out of memory"), "error: out of memory: CUDA"),
    ],
)
def test_an_interruption_and_errors_of_resources_are_one_line(error, line, capsys):
    with pytest.raises(SystemExit):
        raised(error)
    found = capsys.readouterr().err
    assert found.startswith(line)
    assert found.count("\n") == 1


@plain_errors
def raised(error):
    raise error


@pytest.mark.parametrize("number", [errno.EINVAL, errno.EEXIST, errno.EISDIR, errno.ENOTEMPTY])
def test_a_defect_is_no_error_of_resources(number):
    with pytest.raises(OSError, match="a defect"):
        raised(OSError(number, "a defect"))


@pytest.mark.skipif(os.geteuid() == 0, reason="root can write everywhere")
def test_a_folder_without_permission_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(ConfigError, match="Permission denied"):
        check_writable_file(tmp_path / "file")
