"""Environments of the covid test."""

import pytest

from tests.tasks.open_loop.covid_test.scenes import TASK


@pytest.fixture
def make(make_env):
    """Return a function that makes and resets an environment."""

    def build(**config):
        env = make_env(TASK, **config)
        env.reset()
        return env

    return build
