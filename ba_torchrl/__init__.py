"""BulletArm's robot-manipulation tasks and equivariant baselines, native to TorchRL."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ba_torchrl.core.lazy import lazy_names
from ba_torchrl.envs.registration import register_with_gymnasium

if TYPE_CHECKING:
    from ba_torchrl.core.config import WorkerOptions
    from ba_torchrl.core.env_config import EnvConfig
    from ba_torchrl.envs.base import BulletArmEnv
    from ba_torchrl.envs.description import describe
    from ba_torchrl.envs.factory import make, make_vector_env
    from ba_torchrl.envs.settings import ResolvedEnv, resolve_env
    from ba_torchrl.training.policy import load_policy

__version__ = "0.1.0"

_MODULES = {
    "BulletArmEnv": "envs.base",
    "EnvConfig": "core.env_config",
    "ResolvedEnv": "envs.settings",
    "WorkerOptions": "core.config",
    "describe": "envs.description",
    "load_policy": "training.policy",
    "make": "envs.factory",
    "make_vector_env": "envs.factory",
    "resolve_env": "envs.settings",
}
"""Modules of the public names, imported at their first use: TorchRL takes seconds."""

__all__ = [
    "BulletArmEnv",
    "EnvConfig",
    "ResolvedEnv",
    "WorkerOptions",
    "__version__",
    "describe",
    "list_robots",
    "list_tasks",
    "load_policy",
    "make",
    "make_vector_env",
    "resolve_env",
]

register_with_gymnasium()


def list_tasks() -> list[str]:
    """Return the ids of all tasks, such as ``close_loop/block_picking``."""
    from ba_torchrl.tasks.base import TASKS

    return list(TASKS)


def list_robots() -> list[str]:
    """Return the names of all robots, such as ``kuka``."""
    from ba_torchrl.sim.robots.base import ROBOTS

    return list(ROBOTS)


__getattr__, __dir__ = lazy_names(__name__, _MODULES, __all__)
