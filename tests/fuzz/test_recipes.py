"""Command lines of recipes: an error is one line, before work starts."""

import contextlib
import io
from importlib import import_module

import pytest
from hypothesis import strategies as st

from ba_torchrl.cli import EXIT_CODE
from tests.fuzz.values import check, examples
from tests.recipes import load_recipe

WORK = {
    "collect": "ba_torchrl.envs.factory.make_vector_env",
    "graded": "ba_torchrl.training.graded.untrained",
    "experts": "ba_torchrl.demonstrations.collect.expert_scores",
    "play": "ba_torchrl.training.evaluation.record_episodes",
    "soak": "run_soak",
    "measure": "measure",
    "speed": "steps_per_second",
    "evaluate": None,  # there is no checkpoint
    "diagnose": None,  # there is no checkpoint
    "train": "ba_torchrl.training.experiment.Experiment",
    "benchmark": "plan",
    "report": None,  # there is no finished run
    "leaderboard": "read_results",
    "plot": "read_config",
    "gallery": "expert_strip",
    "tasks": "page",
    "teleoperate": "ba_torchrl.envs.factory.make",
    "export": None,  # there is no run
    "convert": None,  # there are no demonstrations
}
"""The first call that works, by recipe: a name in its module, or with a module of its own."""
TEXTS = ("null", "true", "0", "-1", "1", "3", "1.5", ".nan", "1e30", "text", "''", "[]", "[a]")
TEXTS += ("{a: 1}", "close_loop/block_reaching", "open_loop/nothing", "ur5", "/proc/no/x.mp4")
VALUES = st.one_of(st.sampled_from(TEXTS), st.text(max_size=5), st.integers().map(str))


REQUIRED = {
    "evaluate": ["policy=run"],
    "diagnose": ["policy=run"],
    "export": ["policy=run"],
    "train": ["run_dir=new"],
    "benchmark": ["folder=new"],
    "plot": ["runs=[.]"],
    "report": ["runs=."],
}
"""Settings without a default, and folders."""


class StartedError(Exception):
    """The recipe began to work."""


def started(*_, **__):
    raise StartedError


@pytest.mark.parametrize("name", WORK)
@examples(2)
def test_command_lines(name, count, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    module = load_recipe(name)
    if WORK[name] is not None:
        where, _, function = WORK[name].rpartition(".")
        monkeypatch.setattr(import_module(where) if where else module, function, started)
    required = REQUIRED.get(name, [])

    def prop(overrides):
        error = io.StringIO()
        try:
            with contextlib.redirect_stderr(error), contextlib.redirect_stdout(io.StringIO()):
                module.COMMAND.run([*required, *(f"{k}={v}" for k, v in overrides.items())])
            return
        except StartedError:
            return
        except SystemExit as end:
            code = end.code
        assert code == EXIT_CODE
        assert error.getvalue().startswith("error: ")
        assert error.getvalue().count("\n") == 1

    known = sorted(module.COMMAND.settings.model_fields)
    keys = st.sampled_from([*known, "env.robot", "env.obs_size", "algorithm.batch_size"])
    check(count, st.dictionaries(keys, VALUES, min_size=1, max_size=2), prop, shrinks=False)
