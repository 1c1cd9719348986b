"""Vectors of environments, in this process or in worker processes."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ba_torchrl.core.config import MAX_ENVS, WorkerOptions
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.vector.batching import MakeEnv, SerialVectorEnv, Vector
from ba_torchrl.envs.vector.parallel import VectorEnv

_SHARED_MEMORY = Path("/dev/shm")

MIN_CONCURRENT_PROCESSES = 3
"""Least number of processes at a time that step faster than one. Two take 1.05 to 1.6 times as long
as one process on two cores (docs/performance.md, throughput)."""


def processes_save_time(num_envs: int) -> bool:
    """Return whether one process per environment is expected to step faster than one process."""
    return min(num_envs, available_cores()) >= MIN_CONCURRENT_PROCESSES


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def make_vector(
    make_env: MakeEnv | Sequence[MakeEnv],
    num_envs: int,
    *,
    seed: int | None = None,
    workers: WorkerOptions = WorkerOptions(),  # noqa: B008 -- immutable
) -> Vector:
    """Return ``num_envs`` environments as one, with batch size [num_envs], ready to be reset.

    Args:
        make_env: builds one environment, or a list with one such function per environment. A
            `functools.partial` of an importable function or class works with every start method.
        num_envs: number of environments.
        seed: environment i is seeded with ``seed + i``, both in this process and in workers.
        workers: how the environments are started, and replaced when they fail.

    Raises:
        ValueError: ``num_envs`` is below one or differs from the number of functions.
        ConfigError: there are not enough file handles, processes or shared memory for
            ``num_envs``.
        RuntimeError: a worker could not be started.
    """
    if not isinstance(num_envs, int | np.integer) or num_envs < 1:
        raise ValueError(f"num_envs must be a number of at least 1, got {num_envs!r}")
    if not callable(make_env) and len(make_env) != num_envs:
        raise ValueError(f"{len(make_env)} functions were given for {num_envs} environments")
    if num_envs > MAX_ENVS:
        raise ConfigError(f"num_envs: at most {MAX_ENVS}, the number of worlds of PyBullet")
    env: Vector
    if workers.parallel:
        env = VectorEnv(num_envs, make_env, workers=workers)
    else:
        env = SerialVectorEnv(num_envs, make_env)
    try:
        if workers.parallel:
            _check_shared_memory(env)
        env.start()
    except OSError as error:
        if error.errno not in (errno.EMFILE, errno.ENFILE, errno.EAGAIN, errno.ENOMEM):
            raise
        raise ConfigError(
            f"{num_envs} processes cannot be started ({error.strerror}): lower num_envs, or raise "
            "the limits that `ulimit -n` and `ulimit -u` show"
        ) from error
    if seed is not None:
        env.set_consecutive_seeds(seed)
    return env


def _check_shared_memory(env: Vector) -> None:
    """Check the space for the observations of all workers; too little would end this process."""
    if not _SHARED_MEMORY.is_dir():
        return
    needed = sum(value.nbytes for value in env.fake_tensordict()["next"].values(True, True))
    free = shutil.disk_usage(_SHARED_MEMORY).free
    if needed > free:
        raise ConfigError(
            f"{_SHARED_MEMORY} has {free / 1e6:.1f} MB free, {env.num_workers} environments need "
            f"{needed / 1e6:.1f} MB: lower num_envs, or enlarge it (docker run --shm-size)"
        )
