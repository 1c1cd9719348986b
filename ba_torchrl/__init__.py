"""BulletArm's robot-manipulation tasks and equivariant baselines, native to TorchRL."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ba_torchrl.envs.registration import register_with_gymnasium

if TYPE_CHECKING:
    from ba_torchrl.envs.factory import make, make_vector_env

__version__ = "0.1.0"

__all__ = ["__version__", "list_tasks", "make", "make_vector_env"]

register_with_gymnasium()


def list_tasks() -> list[str]:
    """Return the ids of all tasks, such as ``close_loop/block_picking``."""
    from ba_torchrl.tasks.base import TASKS

    return list(TASKS)


def __getattr__(name: str) -> Any:
    if name in ("make", "make_vector_env"):
        from ba_torchrl.envs import factory  # imports TorchRL, which takes seconds

        return getattr(factory, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
