"""Environments that are closed after the test."""

import pytest

import ba_torchrl


@pytest.fixture
def make_env():
    """Return a function that makes an environment with an expert and small images."""
    envs = []

    def build(task, **config):
        env = ba_torchrl.make(task, **{"obs_size": 32, "seed": 0, "expert": True, **config})
        envs.append(env)
        return env

    yield build
    for env in envs:
        env.close()


@pytest.fixture
def make_started(make_env):
    """Return a function that makes an environment without an expert and starts an episode."""

    def build(task, **config):
        env = make_env(task, **{"obs_size": 16, "expert": False, **config})
        env.reset()
        return env

    return build
