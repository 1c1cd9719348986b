"""The additions of ``mine/``, registered for the tests of this folder only."""

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
MODULES = sorted(path.stem for path in (HERE / "mine").glob("*.py"))
REGISTRIES = (TASKS, ROBOTS, OBSERVATIONS, NETWORKS, ALGORITHMS)


@pytest.fixture(scope="module", autouse=True)
def additions():
    """Import the additions; other tests run over everything that is registered."""
    assert all(map(len, REGISTRIES))  # all that is built in is registered
    before = [(dict(registry._entries), dict(registry._modules)) for registry in REGISTRIES]
    ids = set(gymnasium.registry)
    sys.path.insert(0, str(HERE))
    for name in MODULES:
        sys.modules.pop(f"mine.{name}", None)
    yield {name: importlib.import_module(f"mine.{name}") for name in MODULES}
    sys.path.remove(str(HERE))
    for registry, (entries, modules) in zip(REGISTRIES, before, strict=True):
        registry._entries, registry._modules = entries, modules
    for new in set(gymnasium.registry) - ids:
        del gymnasium.registry[new]
