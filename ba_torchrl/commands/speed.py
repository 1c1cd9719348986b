"""Measure this machine: steps of environments and updates of learners per second.

ba-torchrl speed
ba-torchrl speed open_loop/bin_packing num_envs=8 updates=0
ba-torchrl speed close_loop/block_picking env.obs_size=128 'networks=[equi]' device=cuda
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Annotated, Any, ClassVar

from pydantic import Field

from ba_torchrl.cli import config_dir
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Count, EnvSettings, NumEnvs, TaskId, Text, as_list
from ba_torchrl.envs.settings import ResolvedEnv, resolve_env
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training.config import ExperimentConfig

LEARNERS = {"close_loop": ("sac", "equi_small"), "open_loop": ("spatial_q", "fcn")}
"""Algorithm and usual network by control."""
WARM_UP_UPDATES, WARM_UP_STEPS = 5, 2
"""First calls, which are slower than later ones and not measured."""


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
    envs = {task: resolve_env(task, settings.env) for task in settings.tasks}
    from ba_torchrl.training.precision import compute_path
    from ba_torchrl.training.presets import started

    with started(config_dir()):
        learners = {task: list(learners_of(task, settings)) for task in settings.tasks}
    print(f"{'':52} {'per second':>10}")
    for task in settings.tasks:
        for name, num_envs, parallel in (
            ("one environment", 1, False),
            (f"{settings.num_envs} in this process", settings.num_envs, False),
            (f"{settings.num_envs} processes", settings.num_envs, True),
        ):
            rate = steps_per_second(envs[task], settings, num_envs, parallel)
            print(f"{task:34} {name:17} {rate:10.1f} steps")
        for config in learners[task]:
            rate = updates_per_second(config, settings)
            print(f"{task:34} {config.label:17} {rate:10.2f} updates, {compute_path(config)}")


def steps_per_second(
    resolved: ResolvedEnv, settings: Settings, num_envs: int, parallel: bool
) -> float:
    """Return the steps of all environments together, in which the expert acts, per second."""
    from ba_torchrl import make_vector_env
    from ba_torchrl.demonstrations import expert_policy

    options = {"parallel": parallel, "register_modules": settings.plugins}
    env = make_vector_env(resolved, num_envs, **options, seed=settings.seed, expert=True)
    with closing(env):
        state = env.reset()

        def step() -> None:
            nonlocal state
            _, state = env.step_and_maybe_reset(expert_policy(state))

        return num_envs * _rate(step, WARM_UP_STEPS, -(-settings.steps // num_envs))


def learners_of(task: str, settings: Settings) -> Iterator[ExperimentConfig]:
    """Yield the configuration of each learner that is measured on a task."""
    from ba_torchrl.training.presets import preset

    algorithm, usual = LEARNERS[TASKS[task].control]
    for network in (settings.networks or [usual]) if settings.updates else ():
        values = settings.model_dump(include={"plugins", "env", "device", "seed"})
        yield ExperimentConfig.parse(
            {
                **values,
                "task": task,
                "algorithm": {"name": algorithm},
                "network": preset("network", network),
                "label": f"{algorithm} {network}",
            }
        )


def updates_per_second(config: ExperimentConfig, settings: Settings) -> float:
    """Return the updates of a learner per second, with a replay of a few demonstrations."""
    import torch

    from ba_torchrl import make_vector_env
    from ba_torchrl.demonstrations import collect_demonstrations
    from ba_torchrl.training.learner import build_learner

    learner = build_learner(config)
    options = {"parallel": False, "seed": settings.seed, "expert": True}
    with closing(make_vector_env(config.env, 1, **options)) as env:
        learner.on_demonstrations(collect_demonstrations(env, 5, seed=settings.seed))

    def wait() -> None:
        if config.torch_device.type == "cuda":
            torch.cuda.synchronize(config.torch_device)

    return _rate(learner.update, WARM_UP_UPDATES, settings.updates, wait)


def _rate(
    call: Callable[[], object],
    warm_up: int,
    times: int,
    wait: Callable[[], object] = lambda: None,
) -> float:
    """Return how often a function can be called in a second; ``wait`` ends what it started."""
    for _ in range(min(warm_up, times)):
        call()
    wait()
    start = time.perf_counter()
    for _ in range(times):
        call()
    wait()
    return times / (time.perf_counter() - start)


COMMAND = Command(main, Settings, positional="tasks")
