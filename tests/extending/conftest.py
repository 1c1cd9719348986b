"""The additions of ``mine/`` and ``templates/``, registered for the tests of this folder only."""

import importlib
import sys
from pathlib import Path

import gymnasium
import pytest

from ba_torchrl.algorithms.base import ALGORITHMS
from ba_torchrl.envs.observations import OBSERVATIONS
from ba_torchrl.modules.base import NETWORKS
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.tasks.base import TASKS

HERE = Path(__file__).parent
TEMPLATES = HERE.parents[1] / "templates"
FOLDERS = [str(HERE), str(TEMPLATES)]
MODULES = sorted(f"mine.{path.stem}" for path in (HERE / "mine").glob("*.py"))
MODULES += sorted(path.stem for path in TEMPLATES.glob("my_*.py"))
REGISTRIES = (TASKS, ROBOTS, OBSERVATIONS, NETWORKS, ALGORITHMS)


@pytest.fixture(scope="module", autouse=True)
def additions():
    """Import the additions; other tests run over everything that is registered."""
    assert all(map(len, REGISTRIES))  # all that is built in is registered
    before = [(dict(registry._entries), dict(registry._modules)) for registry in REGISTRIES]
    ids = set(gymnasium.registry)
    sys.path[:0] = FOLDERS
    yield {name.split(".")[-1]: importlib.import_module(name) for name in MODULES}
    for name in MODULES:
        del sys.modules[name]
    sys.path[:] = [folder for folder in sys.path if folder not in FOLDERS]
    for registry, (entries, modules) in zip(REGISTRIES, before, strict=True):
        registry._entries, registry._modules = entries, modules
    for new in set(gymnasium.registry) - ids:
        del gymnasium.registry[new]
