"""Collect demonstrations from a task's expert or by deconstruction of structures, and save them.

ba-torchrl collect task=close_loop/block_picking episodes=100 path=demos/picking
ba-torchrl collect task=open_loop/house_building_4 source=deconstruction
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from pydantic import Field, model_validator
from typing_extensions import Self

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import (
    Count,
    EnvSettings,
    TaskId,
    VectorSettings,
    check_new,
    check_writable_file,
)
from ba_torchrl.core.config import LocalPath, Source
from ba_torchrl.core.files import atomic_output
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.record.logging import progress_bar
from ba_torchrl.tasks.structures.open_loop import check_has_structure


class Settings(VectorSettings, EnvSettings):
    """Settings of this command."""

    set_by_command: ClassVar[dict[str, str]] = {"seed": "set seed", "expert": "set source"}
    task: TaskId = "close_loop/block_picking"
    """Id of the task."""
    path: LocalPath | None = None
    """New folder of the demonstrations; null for that of the task in demos."""
    source: Source = "expert"
    """The expert's episodes, or structures that are taken apart, reversed in time."""
    episodes: Count = 100
    """Their number."""
    only_successful: bool = True
    """Play others in place of failed episodes."""
    noise: float = Field(default=0.0, ge=0, lt=1)
    """Probability of a random action in each step; the expert's is stored beside it."""
    turn_noise: float = Field(default=0.0, ge=0, lt=1)
    """Probability of a random turn beside the expert's other components."""

    @model_validator(mode="after")
    def _check_path(self) -> Self:
        check_new(self.folder)
        check_writable_file(self.folder)
        return self

    @property
    def folder(self) -> Path:
        """The folder of the demonstrations."""
        return Path(self.path or f"demos/{self.task.replace('/', '_')}")


def main(settings: Settings) -> None:
    """Play the expert's episodes, or deconstruct structures, and write them into a folder."""
    task, source, seed = settings.task, settings.source, settings.seed
    resolved = resolve_env(task, settings.env)
    if source == "deconstruction":
        check_has_structure(task)
    from ba_torchrl.demonstrations.collect import (
        check_noise,
        check_turn_noise,
        collect_demonstrations,
        source_config,
    )
    from ba_torchrl.demonstrations.demo_files import save_demonstrations
    from ba_torchrl.demonstrations.episodes import is_success, mean_length, success_rate

    check_noise(settings.noise, source, "noise")
    check_turn_noise(settings.turn_noise, source, resolved.actions.turns, "turn_noise")
    with atomic_output(settings.folder) as scratch:
        with (
            settings.make_env(resolved, seed=seed, **source_config(source)) as env,
            progress_bar(total=settings.episodes, unit="episode") as bar,
        ):
            episodes = collect_demonstrations(
                env,
                settings.episodes,
                seed=seed,
                source=source,
                only_successful=settings.only_successful,
                noise=settings.noise,
                turn_noise=settings.turn_noise,
                turns=resolved.actions.turns,
                primitive=resolved.actions.primitive,
                on_episode=lambda episode: bar.update(
                    is_success(episode) or not settings.only_successful
                ),
            )
        save_demonstrations(
            scratch, episodes, task=task, env=settings.env, seed=seed, source=source
        )
    print(
        f"{len(episodes)} episodes of {task}, success {success_rate(episodes):.2f}, "
        f"{mean_length(episodes):.1f} steps each, in {settings.folder}"
    )


COMMAND = Command(main, Settings, positional="task")
