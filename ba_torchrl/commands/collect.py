"""Collect demonstrations from a task's expert or by deconstruction of structures, and save them.

ba-torchrl collect task=close_loop/block_picking episodes=100 path=demos/picking
ba-torchrl collect task=open_loop/house_building_4 source=deconstruction
ba-torchrl collect task=open_loop/house_building_4 source=deconstruction replays=200
"""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from ba_torchrl import make_vector_env
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Count, EnvSettings, NewPath, TaskId, VectorSettings
from ba_torchrl.data.demo_files import save_demonstrations
from ba_torchrl.data.demos import (
    Source,
    check_noise,
    check_turn_noise,
    collect_demonstrations,
    source_config,
)
from ba_torchrl.data.episodes import mean_length, success_rate
from ba_torchrl.data.time_reversal import check_has_structure, replay_scores
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.errors import ConfigError
from ba_torchrl.record.logging import progress_bar


class Settings(VectorSettings, EnvSettings):
    """Settings of this command."""

    set_by_command: ClassVar[dict[str, str]] = {"seed": "set seed", "expert": "set source"}
    task: TaskId = "close_loop/block_picking"
    """Id of the task."""
    path: NewPath = "demos/${file_name:${task}}"
    """New folder of the demonstrations."""
    source: Source = "expert"
    """The expert's episodes, or structures that are taken apart, reversed in time."""
    episodes: Count = 100
    """Their number."""
    replays: int = Field(default=0, ge=0)
    """Deconstruction: number of episodes whose reversal is checked in the simulator."""
    only_successful: bool = True
    """Leave out failed episodes."""
    noise: float = Field(default=0.0, ge=0, lt=1)
    """Probability of a random action in each step; the expert's is stored beside it."""
    turn_noise: float = Field(default=0.0, ge=0, lt=1)
    """Probability of a random turn beside the expert's other components."""


def main(settings: Settings) -> None:
    """Play the expert's episodes and write them into a folder."""
    actions = resolve_env(settings.task, settings.env).actions
    check_noise(settings.noise, settings.source, "noise")
    check_turn_noise(settings.turn_noise, settings.source, actions.turns, "turn_noise")
    if settings.source == "deconstruction":
        check_has_structure(settings.task)
    env = make_vector_env(
        settings.task,
        settings.num_envs,
        parallel=settings.parallel,
        register_modules=settings.plugins,
        **{**settings.env, "seed": settings.seed, **source_config(settings.source)},
    )
    try:
        with progress_bar(total=settings.episodes, unit="episode") as bar:
            episodes = collect_demonstrations(
                env,
                settings.episodes,
                seed=settings.seed,
                source=settings.source,
                only_successful=settings.only_successful,
                noise=settings.noise,
                turn_noise=settings.turn_noise,
                turns=actions.turns,
                primitive=actions.primitive,
                on_episode=lambda _: bar.update(),
            )
    finally:
        env.close()
    if not episodes:
        raise ConfigError(f"none of {settings.episodes} episodes of {settings.task} can be used")
    save_demonstrations(
        settings.path,
        episodes,
        task=settings.task,
        env=settings.env,
        seed=settings.seed,
        source=settings.source,
    )
    print(
        f"{len(episodes)} episodes of {settings.task}, success {success_rate(episodes):.2f}, "
        f"{mean_length(episodes):.1f} steps each, in {settings.path}"
    )
    if settings.replays and settings.source == "deconstruction":
        scores = replay_scores(settings.task, settings.replays, seed=settings.seed, **settings.env)
        print(
            f"of {settings.replays} structures taken apart {scores.reversible:.3f} can be "
            f"reversed; played in the simulator, {scores.success_rate:.3f} of these reach the goal"
        )


COMMAND = Command(main, Settings, positional="task")
