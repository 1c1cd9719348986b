"""Collect graded sets of demonstrations, for offline learning: TASK/GRADE in a folder.

The grades are random, expert, medium (a policy of half success) and mixed. The same command makes
sets that are missing.

ba-torchrl graded close_loop/block_picking ramp/block_stacking env.obs_size=64 path=graded
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Count, EnvSettings, OutputFolder, TaskId, VectorSettings, as_list
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.logging import progress_bar


class Settings(VectorSettings, EnvSettings):
    """Settings of this command."""

    set_by_command: ClassVar[dict[str, str]] = {
        "seed": "set seed",
        "expert": "know that each grade has its policy",
    }
    tasks: Annotated[list[TaskId], Field(min_length=1), as_list]
    """Ids of tasks, or one."""
    path: OutputFolder = "demos/graded"
    """Folder of the sets."""
    episodes: Count = 100
    """Their number, in each set."""


def main(settings: Settings) -> None:
    """Make every set that is missing; a task that has no medium policy does not stop the others."""
    from ba_torchrl.demonstrations.demo_files import read_metadata
    from ba_torchrl.training.graded import ACCEPTED, GRADES, GradedSets, untrained

    if len(set(settings.tasks)) < len(settings.tasks):
        raise ConfigError("tasks: name each one once")
    of_tasks = [
        GradedSets(
            Path(settings.path, task), task, **settings.model_dump(exclude={"tasks", "path"})
        )
        for task in settings.tasks
    ]
    for sets in of_tasks:
        try:
            untrained(sets)
        except ConfigError as error:
            raise ConfigError(f"medium of {sets.task}: {error}") from None
    problems = []
    least, most = ACCEPTED
    for sets in of_tasks:
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


COMMAND = Command(main, Settings, positional="tasks")
