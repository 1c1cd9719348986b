"""Collect demonstrations from a task's expert or by deconstruction of structures, and save them.

With source=graded, sets for offline learning are made: TASK/GRADE in the folder, for the grades
random, expert, medium (a policy of half success) and mixed. The same command makes missing ones.

ba-torchrl collect task=close_loop/block_picking episodes=100 path=demos/picking
ba-torchrl collect source=graded 'task=[close_loop/block_picking,ramp/block_stacking]' path=graded
ba-torchrl collect task=open_loop/house_building_4 source=deconstruction
ba-torchrl collect task=open_loop/house_building_4 source=deconstruction replays=200
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field, model_validator
from typing_extensions import Self

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import (
    Count,
    EnvSettings,
    TaskId,
    Text,
    VectorSettings,
    as_list,
    check_new,
    check_writable_file,
    check_writable_folder,
)
from ba_torchrl.core.config import Source, changed
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import complete_only
from ba_torchrl.envs.settings import check_env, resolve_env
from ba_torchrl.record.logging import progress_bar
from ba_torchrl.tasks.structures.open_loop import check_has_structure

if TYPE_CHECKING:
    from ba_torchrl.training.graded import GradedSets

_NOT_GRADED = ("replays", "only_successful", "noise", "turn_noise")


class Settings(VectorSettings, EnvSettings):
    """Settings of this command."""

    set_by_command: ClassVar[dict[str, str]] = {"seed": "set seed", "expert": "set source"}
    task: Annotated[list[TaskId], Field(min_length=1), as_list] = Field(
        default=["close_loop/block_picking"]
    )
    """Id of the task; with source=graded also a list of them."""
    path: Text | None = None
    """New folder of the demonstrations, or that of graded sets; null for one in demos."""
    source: Source | Literal["graded"] = "expert"
    """The expert's episodes, structures that are taken apart, reversed in time, or all grades."""
    episodes: Count = 100
    """Their number, in each set."""
    replays: int = Field(default=0, ge=0)
    """Deconstruction: number of episodes whose reversal is checked in the simulator."""
    only_successful: bool = True
    """Play others in place of failed episodes."""
    noise: float = Field(default=0.0, ge=0, lt=1)
    """Probability of a random action in each step; the expert's is stored beside it."""
    turn_noise: float = Field(default=0.0, ge=0, lt=1)
    """Probability of a random turn beside the expert's other components."""

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        if self.source == "graded":
            for message in changed(self, _NOT_GRADED, "with source=graded; leave it out"):
                raise ConfigError(message)
            if len(set(self.task)) < len(self.task):
                raise ConfigError("task: name each one once")
            from ba_torchrl.training.graded import untrained

            for sets in self.graded_sets():
                try:
                    untrained(sets)
                except ConfigError as error:
                    raise ConfigError(f"medium of {sets.task}: {error}") from None
            check_writable_folder(self.folder)
        else:
            if len(self.task) > 1:
                raise ConfigError("task: name one; several are for source=graded")
            check_new(self.folder)
            check_writable_file(self.folder)
        return self

    @property
    def folder(self) -> Path:
        """The folder of the demonstrations, or that of the graded sets of all tasks."""
        name = "graded" if self.source == "graded" else self.task[0].replace("/", "_")
        return Path(self.path or f"demos/{name}")

    def graded_sets(self) -> Iterator[GradedSets]:
        """Yield the graded sets of each task."""
        from ba_torchrl.training.graded import GradedSets

        for task in self.task:
            yield GradedSets(
                self.folder / task,
                task,
                self.episodes,
                self.env,
                self.seed,
                self.num_envs,
                self.parallel,
                self.plugins,
            )


def main(settings: Settings) -> None:
    """Play episodes and write them into a folder."""
    if settings.source == "graded":
        _collect_graded(settings)
    else:
        _collect(settings)


def _collect_graded(settings: Settings) -> None:
    """Make every set that is missing; a task that has no medium policy does not stop the others."""
    from ba_torchrl.demonstrations.demo_files import read_metadata
    from ba_torchrl.training.graded import ACCEPTED, GRADES

    problems = []
    least, most = ACCEPTED
    for sets in settings.graded_sets():
        try:
            for grade in GRADES:
                with progress_bar(total=settings.episodes, unit="episode") as bar:
                    sets.make(grade, lambda _, bar=bar: bar.update())
                found = read_metadata(sets.path(grade))
                print(
                    f"{sets.task} {grade}: {found['episodes']} episodes, success "
                    f"{found['success_rate']:.2f}, mean return {found['mean_return']:.2f}, "
                    f"{found['policy']}, in {sets.path(grade)}"
                )
                if grade == "medium" and not least <= found["success_rate"] <= most:
                    problems.append(f"{sets.path(grade)}: success is not from {least} to {most}")
        except ConfigError as error:
            problems.append(f"{sets.task}: {error}")
    if problems:
        raise ConfigError("; ".join(problems))


def _collect(settings: Settings) -> None:
    """Play the expert's episodes, or deconstruct structures."""
    (task,) = settings.task
    check_env(task, settings.env)  # before the import of torch
    from ba_torchrl import make_vector_env
    from ba_torchrl.demonstrations.collect import (
        check_noise,
        check_turn_noise,
        collect_demonstrations,
        source_config,
    )
    from ba_torchrl.demonstrations.demo_files import save_demonstrations
    from ba_torchrl.demonstrations.episodes import is_success, mean_length, success_rate
    from ba_torchrl.demonstrations.time_reversal import replay_scores

    path = settings.folder
    actions = resolve_env(task, settings.env).actions
    check_noise(settings.noise, settings.source, "noise")
    check_turn_noise(settings.turn_noise, settings.source, actions.turns, "turn_noise")
    if settings.source == "deconstruction":
        check_has_structure(task)
    with complete_only(path) as scratch:
        env = make_vector_env(
            task,
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
                    on_episode=lambda episode: bar.update(
                        is_success(episode) or not settings.only_successful
                    ),
                )
        finally:
            env.close()
        save_demonstrations(
            scratch,
            episodes,
            task=task,
            env=settings.env,
            seed=settings.seed,
            source=settings.source,
        )
    print(
        f"{len(episodes)} episodes of {task}, success {success_rate(episodes):.2f}, "
        f"{mean_length(episodes):.1f} steps each, in {path}"
    )
    if settings.replays and settings.source == "deconstruction":
        scores = replay_scores(task, settings.replays, seed=settings.seed, **settings.env)
        print(
            f"of {settings.replays} structures taken apart {scores.reversible:.3f} can be "
            f"reversed; played in the simulator, {scores.success_rate:.3f} of these reach the goal"
        )


COMMAND = Command(main, Settings, positional="task")
