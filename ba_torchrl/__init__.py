"""BulletArm's robot-manipulation tasks and equivariant baselines, native to TorchRL."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ba_torchrl.core.lazy import lazy_names
from ba_torchrl.envs.registration import register_with_gymnasium

if TYPE_CHECKING:
    from ba_torchrl.core.config import WorkerOptions as WorkerOptions
    from ba_torchrl.core.env_config import EnvConfig as EnvConfig
    from ba_torchrl.envs.base import BulletArmEnv as BulletArmEnv
    from ba_torchrl.envs.description import describe as describe
    from ba_torchrl.envs.factory import make as make, make_vector_env as make_vector_env
    from ba_torchrl.envs.settings import ResolvedEnv as ResolvedEnv, resolve_env as resolve_env
    from ba_torchrl.training.policy import load_policy as load_policy

__version__ = "0.1.0"

register_with_gymnasium()


def list_tasks() -> list[str]:
    """Return the ids of all tasks, such as ``close_loop/block_picking``."""
    from ba_torchrl.tasks.base import TASKS

    return list(TASKS)


def list_robots() -> list[str]:
    """Return the names of all robots, such as ``kuka``."""
    from ba_torchrl.sim.robots.base import ROBOTS

    return list(ROBOTS)


__getattr__, __dir__, __all__ = lazy_names(__name__)
