"""Damaged and altered files of demonstrations, runs and results: only documented errors."""

import json
import shutil
import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import strategies as st

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import CHECKSUMS_FILE, read_state, write_checksums, write_state
from ba_torchrl.demonstrations.demo_files import load_demonstrations, save_demonstrations
from ba_torchrl.record.logging import read_scalars
from ba_torchrl.record.results import read_result, run_folders
from ba_torchrl.training.checkpoint import Checkpoints, load, write_config
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.learner import build_learner
from tests.fuzz.values import JSON, check, examples
from tests.tasks.episodes import demonstrations

TASK, ENV = "close_loop/block_reaching", {"obs_size": 64, "max_steps": 4}
RUN = {
    "task": TASK,
    "env": ENV,
    "algorithm": {"name": "sac", "replay": {"name": "uniform", "capacity": 20}, "batch_size": 4},
    "network": {"name": "cnn", "width": 0.125},
    "num_envs": 1,
    "parallel": False,
    "demonstrations": 0,
    "min_replay": 4,
    "device": "cpu",
}


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "demos"
    episodes = demonstrations(TASK, 2, env=ENV)
    save_demonstrations(path, episodes, task=TASK, env=ENV, seed=0)
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    config = ExperimentConfig.parse({**RUN, "run_dir": str(tmp_path_factory.mktemp("run"))})
    write_config(config)
    learner = build_learner(config)
    Checkpoints(config.folder, learner).save(1, 0.5)
    return config.folder


@pytest.fixture(scope="module")
def state(tmp_path_factory):
    path = tmp_path_factory.mktemp("state") / "state"
    write_state(path, {"step": 3, "rows": [1, None, "text"], "pair": (0.5, torch.ones(2))})
    write_checksums(path)
    return path


DAMAGES = st.one_of(
    st.tuples(st.just("cut"), st.floats(0, 0.999)),
    st.tuples(st.just("flip"), st.floats(0, 0.999)),
    st.tuples(st.just("delete"), st.none()),
    st.tuples(st.just("bytes"), st.binary(max_size=30)),
    st.tuples(st.just("json"), JSON),
    st.tuples(st.just("entry"), st.tuples(st.integers(0, 50), JSON)),
)
CASES = st.tuples(st.integers(0, 1000), DAMAGES, st.booleans())


def damage(path, how, value):
    """Alter one file; ``entry`` replaces one entry of a JSON object."""
    content = path.read_bytes()
    if how == "delete":
        path.unlink()
    elif how == "cut":
        path.write_bytes(content[: int(len(content) * value)])
    elif how == "flip" and content:
        place = int(len(content) * value)
        path.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
    elif how == "bytes":
        path.write_bytes(value)
    elif how == "json":
        path.write_text(json.dumps(value))
    elif how == "entry" and path.suffix in (".json", ".yaml"):
        number, entry = value
        try:
            whole = json.loads(content)
        except ValueError:
            return
        if isinstance(whole, dict) and whole:
            whole[sorted(whole)[number % len(whole)]] = entry
            path.write_text(json.dumps(whole))


def altered(folder, sealed, read):
    """Return the property that reading a copy with one altered file raises `ConfigError` at most.

    Args:
        folder: whose files are altered.
        sealed: folders in it with checksums, which are written anew for half of the cases.
        read: opens the copy.
    """

    def prop(case):
        number, (how, value), reseal = case
        with tempfile.TemporaryDirectory() as scratch:
            copy = Path(scratch) / "copy"
            shutil.copytree(folder, copy)
            files = sorted(path for path in copy.rglob("*") if path.is_file())
            chosen = files[number % len(files)]
            damage(chosen, how, value)
            try:
                if reseal and chosen.name != CHECKSUMS_FILE:
                    for part in sealed(copy):
                        write_checksums(part)
                read(copy)
            except ConfigError:
                pass  # documented

    return prop


@examples(20)
def test_demonstrations(demos, count):
    def read(path):
        assert load_demonstrations(path, task=TASK, env=ENV)

    check(count, CASES, altered(demos, lambda copy: [copy], read))


@examples(15)
def test_checkpoints(run, count):
    def sealed(copy):
        return [path.parent for path in copy.rglob(CHECKSUMS_FILE)]

    check(count, CASES, altered(run, sealed, lambda copy: load(copy, "latest")))


@examples(40)
def test_states(state, count):
    check(count, CASES, altered(state, lambda copy: [copy], read_state))


@examples(50)
def test_results(tmp_path, count):
    def prop(content):
        run = tmp_path / "run"
        run.mkdir(exist_ok=True)
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        for name in ("result.json", "failure.json"):
            (run / name).write_bytes(data)
        run_folders([tmp_path])
        with pytest.raises(ValueError, match="has no valid result"):
            read_result(run)

    check(count, st.one_of(st.binary(max_size=40), JSON), prop)


ROWS = st.lists(st.lists(st.text(max_size=5), max_size=4).map(",".join), max_size=4).map(
    lambda rows: "\n".join(["step,name,value", *rows, ""]).encode()
)
"""Files with the columns of scalars and any rows."""


@examples(50)
def test_scalars(tmp_path, count):
    path = tmp_path / "scalars.csv"
    path.write_text("step,name,value\n0,loss,1.5\n20,loss,0.5\n20,eval/success_rate,1.0\n")
    content = path.read_bytes()
    assert read_scalars(path)["loss"].values.tolist() == [1.5, 0.5]

    def prop(changes):
        how, value = changes
        path.write_bytes(content)
        damage(path, how, value)
        try:
            for series in read_scalars(path).values():
                assert len(series.steps) == len(series.values) > 0
        except (FileNotFoundError, ValueError):
            pass  # documented

    check(count, st.one_of(DAMAGES, st.tuples(st.just("bytes"), ROWS)), prop)
