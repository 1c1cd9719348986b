"""Command lines of recipes: an error is one line, before work starts."""

import contextlib
import io

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from hypothesis import strategies as st
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ba_torchrl.training import hydra_schema
from ba_torchrl.training.command_line import EXIT_CODE
from tests.fuzz.values import check, examples
from tests.recipes import ROOT, load_recipe

WORK = {
    "collect_demos": "make_vector_env",
    "experts": "expert_scores",
    "play": "record_episodes",
    "soak": "run_soak",
    "speed": "measure",
    "evaluate": None,  # there is no checkpoint
    "train": "Experiment",
    "benchmark": "plan",
    "report": None,  # there is no finished run
    "plot": "read_config",
    "gallery": "expert_strip",
    "tasks": "task_page",
}
"""The first call that works, by recipe."""
TEXTS = ("null", "true", "0", "-1", "1", "3", "1.5", ".nan", "1e30", "text", "''", "[]", "[a]")
TEXTS += ("{a: 1}", "close_loop/block_reaching", "open_loop/nothing", "ur5", "/proc/no/x.mp4")
VALUES = st.one_of(st.sampled_from(TEXTS), st.text(max_size=5), st.integers().map(str))


REQUIRED = {
    "evaluate": ["checkpoint=run"],
    "train": ["label=a", "run_dir=new"],
    "benchmark": ["name=a", "folder=new"],
    "plot": ["runs=[.]"],
    "report": ["runs=."],
}
"""Settings without a default, or whose default is only known to Hydra's command line."""


class StartedError(Exception):
    """The recipe began to work."""


def started(*_, **__):
    raise StartedError


@pytest.fixture
def recipe(request, monkeypatch, tmp_path):
    """The function of a recipe whose work is replaced, and its settings by overrides."""
    name = request.param
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [name])
    module = load_recipe(name)
    if WORK[name] is not None:
        monkeypatch.setattr(module, WORK[name], started)
    hydra_schema.register()
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        yield name, module.main.__wrapped__


@pytest.mark.parametrize("recipe", WORK, indirect=True)
@examples(12)
def test_command_lines(recipe, count):
    name, main = recipe
    required = REQUIRED.get(name, [])
    known = OmegaConf.to_container(compose(name, overrides=required))

    def prop(overrides):
        changes = [f"{key}={value}" for key, value in overrides.items()]
        try:
            settings = compose(name, overrides=required + changes)
        except (HydraException, OmegaConfBaseException, ValueError):
            return  # Hydra reports it
        error = io.StringIO()
        try:
            with contextlib.redirect_stderr(error), contextlib.redirect_stdout(io.StringIO()):
                main(settings)
            return
        except StartedError:
            return
        except SystemExit as end:
            code = end.code
        assert code == EXIT_CODE
        assert error.getvalue().startswith("error: ")
        assert "Traceback" not in error.getvalue()

    keys = st.one_of(st.sampled_from(sorted(known)), st.sampled_from(["env.robot", "env.obs_size"]))
    check(count, st.dictionaries(keys, VALUES, min_size=1, max_size=2), prop, shrinks=False)
