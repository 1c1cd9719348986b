"""BulletArm's robot-manipulation tasks and equivariant baselines, native to TorchRL."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ba_torchrl.envs.registration import register_with_gymnasium

if TYPE_CHECKING:
    from types import ModuleType

    from torchrl.envs import EnvBase

    from ba_torchrl.envs.base import ManipulationEnv

__version__ = "0.1.0"

__all__ = ["__version__", "list_tasks", "make", "make_vector_env"]

register_with_gymnasium()


def list_tasks() -> list[str]:
    """Return the ids of all tasks, such as ``close_loop/block_picking``."""
    from ba_torchrl.tasks.base import TASKS

    return list(TASKS)


def make(task: str, **config: Any) -> ManipulationEnv:
    """Make a TorchRL environment.

    Args:
        task: one of `list_tasks`.
        config: fields of `ba_torchrl.config.EnvConfig`, such as ``robot="kuka"``, ``seed=0`` or
            ``expert=True``.

    Raises:
        ConfigError: the task or a parameter is unknown, or its value cannot be used.
    """
    from ba_torchrl.envs.factory import make_env

    return make_env(task, **config)


def make_vector_env(
    task: str,
    num_envs: int,
    *,
    parallel: bool | None = True,
    start_method: str = "spawn",
    register_modules: Sequence[str | ModuleType] = (),
    timeout_s: float = 60.0,
    max_restarts: int = 5,
    start_timeout_s: float = 120.0,
    wait_for_restarts: bool = True,
    **config: Any,
) -> EnvBase:
    """Make ``num_envs`` environments that step together.

    Args:
        task: one of `list_tasks`.
        num_envs: how many; environment i has the seed ``seed + i``.
        parallel: one process each (a TorchRL ``ParallelEnv`` that survives its workers), or all
            in this process (``SerialEnv``). The same seed gives the same episodes in both. None
            chooses processes where at least three of them can run at a time: with fewer, their
            communication takes more time than they save (docs/performance.md).
        start_method: ``spawn`` or ``fork``, how processes start. With ``spawn``, scripts need
            an ``if __name__ == "__main__":`` guard.
        register_modules: modules outside the package that each process imports before it makes its
            environment, such as ``["my_tasks"]``. Those that register the task and the robot are
            found without being named.
        timeout_s: seconds after which a process that does not answer is replaced.
        max_restarts: largest number of failures in a row of a process, of attempts to start it or
            without a completed step.
        start_timeout_s: seconds after which a process that does not start is replaced.
        wait_for_restarts: whether the environment of a failed process is reset before the next
            step. Otherwise it reports faults until its new process is ready; see `VectorEnv`.
        config: as for `make`.

    Raises:
        ConfigError: as for `make`.
    """
    from ba_torchrl.envs.factory import make_vector

    return make_vector(
        task,
        num_envs,
        parallel=parallel,
        start_method=start_method,
        register_modules=register_modules,
        timeout_s=timeout_s,
        max_restarts=max_restarts,
        start_timeout_s=start_timeout_s,
        wait_for_restarts=wait_for_restarts,
        **config,
    )
