"""Environments by name."""

from __future__ import annotations

from functools import partial
from typing import Any

from torchrl.envs import EnvBase

from ba_torchrl.config import EnvConfig, parse
from ba_torchrl.envs.base import CONTROLS, ManipulationEnv
from ba_torchrl.envs.vector import make_vector_env
from ba_torchrl.tasks.base import TASKS


def make_env(task: str, **config: Any) -> ManipulationEnv:
    """Make one environment; see `ba_torchrl.make`."""
    control = TASKS[task].control
    settings = parse(EnvConfig, config, f"configuration of {task}")
    return CONTROLS[control](task, settings)


def make_vector(
    task: str, num_envs: int, *, parallel: bool, start_method: str, **config: Any
) -> EnvBase:
    """Make environments that step together; see `ba_torchrl.make_vector_env`."""
    seed = parse(EnvConfig, config, f"configuration of {task}").seed
    return make_vector_env(
        partial(make_env, task, **config),
        num_envs,
        seed=seed,
        parallel=parallel,
        start_method=start_method,
    )
