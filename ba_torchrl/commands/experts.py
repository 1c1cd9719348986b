"""Measure the experts: success rate and length of random episodes, as a table in Markdown.

ba-torchrl experts                                 # every task, kuka, with and without yaw
ba-torchrl experts 'robots=[panda,ur5]' episodes=50 'tasks=[close_loop/block_picking]'
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, field_validator
from tqdm import tqdm

from ba_torchrl import list_tasks
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import (
    Count,
    NumEnvs,
    OutputFile,
    PluginSettings,
    Seed,
    Tasks,
    VectorSettings,
    checked,
    without,
)
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import write_text
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.tasks.base import TASKS

Columns = Annotated[dict[str, dict[str, Any]], Field(min_length=1)]
SET_FOR_ALL = {
    **{name: f"set {name}" for name in ("seed", "num_envs", "parallel")},
    "robot": "set robots",
    "expert": "know that all episodes are the expert's",
}
"""What the settings of the recipe determine in every column, and what to do instead."""

_SLOPES = {"pxyzrrr, random yaw": {}}
VARIANTS = {
    "close_loop": {
        "pxyzr, random yaw": {"obs_size": 16},
        "pxyz, fixed yaw": {
            "obs_size": 16,
            "action_sequence": "pxyz",
            "random_orientation": False,
        },
    },
    "open_loop": {
        "pxyr, random yaw": {},
        "pxy, fixed yaw": {"action_sequence": "pxy", "random_orientation": False},
    },
    "ramp": _SLOPES,
    "bump": _SLOPES,
}


class Settings(VectorSettings, PluginSettings):
    """Settings of this command."""

    tasks: Tasks = None
    """Ids of tasks; null for all."""
    robots: list[Annotated[str, checked(ROBOTS.__getitem__)]] = Field(["kuka"], min_length=1)
    """Robots, a row for each."""
    variants: dict[str, Columns] = Field(default_factory=lambda: VARIANTS)
    """Columns of each table: parameters of environments; a table is for a group of tasks or for a
    control."""
    episodes: Count = 200
    """Episodes of each entry."""
    num_envs: NumEnvs = 2
    """Environments that step together."""
    seed: Seed = 0
    """Of the episodes."""
    path: OutputFile | None = None
    """A file that the table is written to."""

    @field_validator("variants")
    @classmethod
    def _check_variants(cls, variants: dict[str, Columns]) -> dict[str, Columns]:
        for columns in variants.values():
            for env in columns.values():
                without(env, **SET_FOR_ALL)
        return variants


def main(settings: Settings) -> None:
    """Play the experts' episodes and print their success and length."""
    variants = settings.variants
    tables = []
    for table, columns in variants.items():
        tasks = [
            task for task in settings.tasks or list_tasks() if _table_of(task, variants) == table
        ]
        if not tasks:
            continue
        lines = [
            f"| task | robot | {' | '.join(columns)} |",
            f"|---|---|{'---|' * len(columns)}",
        ]
        cells = [(task, robot) for task in tasks for robot in settings.robots]
        for task, robot in tqdm(cells, unit="row"):
            row = [_cell(task, settings, {**env, "robot": robot}) for env in columns.values()]
            lines.append(f"| `{task}` | {robot} | {' | '.join(row)} |")
            tqdm.write(lines[-1])
        tables.append("\n".join(lines))
    text = "\n\n".join(tables)
    print(f"\n{text}\n\n{settings.episodes} episodes each, seed {settings.seed}")
    if settings.path is not None:
        write_text(settings.path, text + "\n")


def _table_of(task: str, variants: dict[str, Any]) -> str:
    """Return the key of a task's table: its group, the start of its id, or its control."""
    group = task.split("/")[0]
    return group if group in variants else TASKS[task].control


def _cell(task: str, settings: Settings, env: dict[str, Any]) -> str:
    from ba_torchrl.demonstrations.collect import expert_scores

    try:
        scores = expert_scores(
            task,
            settings.episodes,
            seed=settings.seed,
            num_envs=settings.num_envs,
            parallel=settings.parallel,
            **env,
        )
    except ConfigError as error:
        return f"not possible: {error}"
    if not scores.success_rate:
        return "0.000"
    lengths = f"{scores.mean_length:.1f} steps, median {scores.median_length:g}"
    return f"{scores.success_rate:.3f}, {lengths}"


COMMAND = Command(main, Settings, positional="tasks")
