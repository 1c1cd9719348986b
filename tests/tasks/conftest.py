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
