"""Environments of open-loop object grasping."""

import pytest

from tests.tasks.open_loop.object_grasping.heaps import TASK


@pytest.fixture
def make(make_env):
    """Return a function that makes an environment, with an expert if asked for."""

    def build(**config):
        return make_env(TASK, **{"obs_size": 128, "expert": False, **config})

    return build
