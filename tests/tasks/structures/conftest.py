"""Scenes for the tests of structures."""

import pytest

from ba_torchrl.sim.world import World
from tests.tasks.structures.scenes import Scene


@pytest.fixture
def scene():
    with World() as world:
        yield lambda blueprint, **spare: Scene(world, blueprint, **spare)
