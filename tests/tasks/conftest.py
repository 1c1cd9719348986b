"""Environments, which are made once for all tests of a module."""

from collections import defaultdict

import pytest

import ba_torchrl


@pytest.fixture(scope="module")
def idle_envs():
    """By task and parameters, environments that no test uses at present."""
    idle = defaultdict(list)
    yield idle
    for env in (env for envs in idle.values() for env in envs):
        env.close()


@pytest.fixture
def make_env(idle_envs):
    """Return a function that makes an environment with an expert and small images, or takes one
    that is idle and sets its seed, after which its episodes are those of a new one."""
    used = []

    def build(task, **config):
        config = {"obs_size": 32, "seed": 0, "expert": True, **config}
        key = task, repr(sorted(config.items()))
        if idle_envs[key]:
            env = idle_envs[key].pop()
            env.set_seed(config["seed"])
        else:
            env = ba_torchrl.make(task, **config)
        used.append((key, env))
        return env

    yield build
    for key, env in used:
        if not env.is_closed:
            idle_envs[key].append(env)


@pytest.fixture
def make_started(make_env):
    """Return a function that makes an environment without an expert and starts an episode."""

    def build(task, **config):
        env = make_env(task, **{"obs_size": 16, "expert": False, **config})
        env.reset()
        return env

    return build
