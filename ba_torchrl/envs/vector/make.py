"""Vectors of environments, in this process or in worker processes."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv

from ba_torchrl.config import MAX_ENVS, WorkerOptions
from ba_torchrl.envs.checks import check_actions
from ba_torchrl.envs.positions import Position
from ba_torchrl.envs.vector.batching import SeededVector
from ba_torchrl.envs.vector.torchrl_names import missing_names
from ba_torchrl.errors import ConfigError, WorkerError

if TYPE_CHECKING:
    from ba_torchrl.envs.vector.parallel import VectorEnv

__all__ = [
    "SerialVectorEnv",
    "check_actions",
    "make_vector",
    "processes_save_time",
]

logger = logging.getLogger(__name__)

MakeEnv = Callable[[], EnvBase]

_SHARED_MEMORY = Path("/dev/shm")

MIN_CONCURRENT_PROCESSES = 3
"""Least number of processes at a time that step faster than one. Two take 1.05 to 1.6 times as long
as one process on two cores (docs/performance.md, throughput)."""


def processes_save_time(num_envs: int) -> bool:
    """Return whether one process per environment is expected to step faster than one process.

    Args:
        num_envs: number of environments.
    """
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
) -> SerialVectorEnv | VectorEnv | PlainVectorEnv:
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
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, got {num_envs}")
    if not callable(make_env) and len(make_env) != num_envs:
        raise ValueError(f"{len(make_env)} functions were given for {num_envs} environments")
    if num_envs > MAX_ENVS:
        raise ConfigError(f"num_envs: at most {MAX_ENVS}, the number of worlds of PyBullet")
    env: SerialVectorEnv | VectorEnv | PlainVectorEnv
    if workers.parallel and missing_names():
        warnings.warn(
            f"this version of TorchRL lacks {', '.join(missing_names())}: the environments are "
            "its ParallelEnv, which does not replace workers that fail",
            stacklevel=3,
        )
        env = PlainVectorEnv(
            num_envs,
            make_env,
            mp_start_method=workers.start_method,
            use_buffers=True,
        )
    elif workers.parallel:
        from ba_torchrl.envs.vector.parallel import VectorEnv

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
        env.set_seed(seed)
    return env


def _check_shared_memory(env: VectorEnv) -> None:
    """Check the space for the observations of all workers; too little would end this process.

    Raises:
        ConfigError: there is not enough.
    """
    if not _SHARED_MEMORY.is_dir():
        return
    needed = sum(value.nbytes for value in env.fake_tensordict().values(True, True))
    free = shutil.disk_usage(_SHARED_MEMORY).free
    if needed > free:
        raise ConfigError(
            f"{_SHARED_MEMORY} has {free / 1e6:.1f} MB free, {env.num_workers} environments need "
            f"{needed / 1e6:.1f} MB: lower num_envs, or enlarge it (docker run --shm-size)"
        )


class PlainVectorEnv(SeededVector, ParallelEnv):
    """Environments in worker processes that are not replaced, by TorchRL's public interface."""

    _is_seeded = False

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int:
        """Seed environment i with ``seed + i`` at the next reset of all; see `SeededVector`."""
        self._set_base_seed(seed)
        self._is_seeded = True
        return seed if static_seed else seed + self.num_workers

    def get_positions(self) -> list[Position]:
        """Raise a `WorkerError`: a run that is resumed plays other episodes."""
        raise WorkerError("TorchRL's ParallelEnv does not tell the episodes of its workers")

    def continue_from(self, positions: Sequence[Position]) -> None:
        """Start new episodes: those of ``positions`` cannot be given to the workers."""
        logger.warning("TorchRL's ParallelEnv cannot continue episodes; others are played")

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, seed: int | None = None, **kwargs: Any
    ) -> TensorDictBase:
        if seed is None and self._is_seeded and (tensordict is None or "_reset" not in tensordict):
            seed, self._is_seeded = self._base_seed, False
        return super()._reset(tensordict, seed=seed, **kwargs)


class SerialVectorEnv(SeededVector, SerialEnv):
    """Environments that step sequentially in this process."""

    def get_positions(self) -> list[Position]:
        """Return the position of each environment; see `SeededVector.get_positions`."""
        return [env.get_position() for env in self._envs]

    def continue_from(self, positions: Sequence[Position]) -> None:
        """Continue episodes; see `SeededVector.continue_from`."""
        for env, position in zip(self._envs, positions, strict=True):
            env.continue_from(position)

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if "shared_tensordict_parent" in state:
            # views of one buffer, which a copy separates: resets are written and read through both
            content = self.shared_tensordict_parent
            self._create_td()
            self.shared_tensordict_parent.update_(content)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the environments, and keep the number of torch threads, which TorchRL increases."""
        threads = torch.get_num_threads()
        super().close(raise_if_closed=raise_if_closed)
        torch.set_num_threads(threads)

    def _seed_env(self, index: int, seed: int) -> None:
        self._envs[index].set_seed(seed, static_seed=True)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check_actions(tensordict)
        steps = tensordict.get("_step", None)
        if steps is not None and not steps.all():
            return super()._step(tensordict)
        # TorchRL's copies through a buffer take three times as long.
        states = tensordict.exclude("_step").unbind(0)
        pairs = zip(self._envs, states, strict=True)
        return torch.stack([env._step(state) for env, state in pairs])
