"""Measure this machine: steps of environments and updates of learners per second.

ba-torchrl speed
ba-torchrl speed open_loop/bin_packing num_envs=8 updates=0
ba-torchrl speed close_loop/block_picking env.obs_size=128 'networks=[equi]' device=cuda
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import Field

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Count, EnvSettings, NumEnvs, TaskId, Text, as_list
from ba_torchrl.envs.settings import check_env
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training import hydra_schema
from ba_torchrl.training.config import ExperimentConfig

if TYPE_CHECKING:
    import torch

LEARNERS = {"close_loop": ("sac", "equi_small"), "open_loop": ("spatial_q", "fcn")}
"""Algorithm and usual network by control."""
WARM_UP_UPDATES = 5
"""First updates, which are slower than later ones and not measured."""


class Settings(EnvSettings):
    """Settings of this command."""

    set_by_command: ClassVar[dict[str, str]] = {
        "seed": "set seed",
        "expert": "know that the expert acts",
    }
    tasks: Annotated[list[TaskId], Field(min_length=1), as_list] = Field(
        ["close_loop/block_picking", "open_loop/house_building_2"]
    )
    """Ids of tasks."""
    env: dict[str, Any] = Field(default_factory=lambda: {"obs_size": 64})
    """Parameters of the environments."""
    num_envs: NumEnvs = 4
    """Environments of the vectors."""
    steps: Count = 200
    """Steps of each measurement."""
    networks: list[Text] | None = Field(default=None, min_length=1)
    """Presets of networks, each measured with SAC in close loop and spatial Q-learning in open
    loop; null for equi_small and fcn."""
    updates: int = Field(default=20, ge=0)
    """Updates of each learner; 0 for none."""
    device: Text = "auto"
    """Of the learners."""


def main(settings: Settings) -> None:
    """Print a table, row by row."""
    for task in settings.tasks:
        check_env(task, settings.env)  # before the import of torch
    from ba_torchrl.training.precision import compute_path

    learners = {task: list(learners_of(task, settings)) for task in settings.tasks}
    print(f"{'':52} {'per second':>10}")
    for task in settings.tasks:
        for name, workers in (
            ("one environment", {"num_envs": 1, "parallel": False}),
            (f"{settings.num_envs} in this process", {"parallel": False}),
            (f"{settings.num_envs} processes", {"parallel": True}),
        ):
            rate = steps_per_second(task, settings, **{"num_envs": settings.num_envs, **workers})
            print(f"{task:34} {name:17} {rate:10.1f} steps")
        for config in learners[task]:
            rate = updates_per_second(config, settings)
            print(f"{task:34} {config.label:17} {rate:10.2f} updates, {compute_path(config)}")


def steps_per_second(task: str, settings: Settings, num_envs: int, parallel: bool) -> float:
    """Return the steps of all environments together, in which the expert acts, per second."""
    from ba_torchrl import make_vector_env
    from ba_torchrl.demonstrations import expert_policy

    env = make_vector_env(
        task,
        num_envs,
        parallel=parallel,
        register_modules=settings.plugins,
        seed=settings.seed,
        expert=True,
        **settings.env,
    )
    steps = -(-settings.steps // num_envs)
    try:
        state = env.reset()
        for _ in range(2):  # builds the images' caches
            _, state = env.step_and_maybe_reset(expert_policy(state))
        start = time.perf_counter()
        for _ in range(steps):
            _, state = env.step_and_maybe_reset(expert_policy(state))
        return steps * num_envs / (time.perf_counter() - start)
    finally:
        env.close()


def learners_of(task: str, settings: Settings) -> Iterator[ExperimentConfig]:
    """Yield the configuration of each learner that is measured on a task."""
    algorithm, usual = LEARNERS[TASKS[task].control]
    for network in (settings.networks or [usual]) if settings.updates else ():
        yield ExperimentConfig.parse(
            {
                "plugins": settings.plugins,
                "task": task,
                "env": settings.env,
                "algorithm": {"name": algorithm},
                "network": hydra_schema.preset("network", network),
                "label": f"{algorithm} {network}",
                "device": settings.device,
                "seed": settings.seed,
            }
        )


def updates_per_second(config: ExperimentConfig, settings: Settings) -> float:
    """Return the updates of a learner per second, with a replay of a few demonstrations."""
    from ba_torchrl import make_vector_env
    from ba_torchrl.demonstrations import collect_demonstrations
    from ba_torchrl.training.learner import build_algorithm

    algorithm = build_algorithm(config)
    env = make_vector_env(config.resolved_env, 1, parallel=False, seed=settings.seed, expert=True)
    try:
        episodes = collect_demonstrations(env, 5, seed=settings.seed)
    finally:
        env.close()
    algorithm.on_demonstrations(episodes)
    for _ in range(min(WARM_UP_UPDATES, settings.updates)):
        algorithm.update()
    _wait(config.torch_device)
    start = time.perf_counter()
    for _ in range(settings.updates):
        algorithm.update()
    _wait(config.torch_device)
    return settings.updates / (time.perf_counter() - start)


def _wait(device: torch.device) -> None:
    import torch

    if device.type == "cuda":
        torch.cuda.synchronize(device)


COMMAND = Command(main, Settings, positional="tasks")
