import multiprocessing
import os
import signal
import sys
from functools import partial
from pathlib import Path

import pytest

import ba_torchrl
from ba_torchrl.core.config import WorkerOptions
from ba_torchrl.envs.vector.make import make_vector
from ba_torchrl.envs.vector.parallel import VectorEnv

# Spawned workers inherit this path and find the modules of the tests there.
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def make(request):
    """Make environments that are closed at the end, with the module's `SETTINGS` or others."""
    settings, made = getattr(request.module, "SETTINGS", {}), []

    def build(task="close_loop/block_picking", **config):
        made.append(ba_torchrl.make(task, **{**settings, **config}))
        return made[-1]

    yield build
    for env in made:
        env.close(raise_if_closed=False)


@pytest.fixture
def make_fakes():
    """Make vectors of fake environments, by default forked, and close them."""
    from fake_env import FakeEnv

    made = []

    def make(num_envs=2, *, seed=0, folder=None, horizon=1000, **options):
        workers = WorkerOptions(**{"start_method": "fork", "timeout_s": 120.0} | options)
        factory = partial(FakeEnv, folder=folder, horizon=horizon)
        env = make_vector(factory, num_envs, seed=seed, workers=workers)
        made.append(env)
        return env

    yield make
    for env in made:
        for pid in env.worker_pids if isinstance(env, VectorEnv) else ():
            os.kill(pid, signal.SIGKILL)  # faster than an orderly end, which tests of `close` see
        env.close(raise_if_closed=False)
    assert multiprocessing.active_children() == []
