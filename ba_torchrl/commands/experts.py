"""Measure the experts: success rate and length of random episodes, as a table in Markdown.

ba-torchrl experts                                 # every task, kuka, with and without yaw
ba-torchrl experts 'robots=[panda,ur5]' episodes=50 'tasks=[close_loop/block_picking]'
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import Field
from tqdm import tqdm

from ba_torchrl import list_tasks
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import (
    Count,
    EnvSettings,
    NewPath,
    NumEnvs,
    Tasks,
    VectorSettings,
    checked,
)
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import write_text
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.record.summary import pipes
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.tasks.base import TASKS

FIXED_YAW = {"random_orientation": False}
SLOPES = {"pxyzrrr, random yaw": {}}
COLUMNS: dict[str, dict[str, dict[str, Any]]] = {
    "close_loop": {
        "pxyzr, random yaw": {"obs_size": 16},
        "pxyz, fixed yaw": {"obs_size": 16, "action_sequence": "pxyz", **FIXED_YAW},
    },
    "open_loop": {
        "pxyr, random yaw": {},
        "pxy, fixed yaw": {"action_sequence": "pxy", **FIXED_YAW},
    },
    "ramp": SLOPES,
    "bump": SLOPES,
}
"""Of each table, parameters of environments by column; a table is for a group of tasks, the start
of their ids, or for a control."""


class Settings(VectorSettings, EnvSettings):
    """Settings of this command."""

    set_by_command: ClassVar[dict[str, str]] = {
        "seed": "set seed",
        "robot": "set robots",
        "expert": "know that all episodes are the expert's",
        "action_sequence": "read the column that it names",
        "random_orientation": "read the column that it names",
    }
    tasks: Tasks = None
    """Ids of tasks; null for all."""
    robots: list[Annotated[str, checked(ROBOTS.__getitem__)]] = Field(["kuka"], min_length=1)
    """Robots, a row for each."""
    episodes: Count = 200
    """Episodes of each entry."""
    num_envs: NumEnvs = 2
    """Environments that step together."""
    path: NewPath | None = None
    """A new file that the tables are written to."""


def main(settings: Settings) -> None:
    """Play the experts' episodes and print their success and length."""
    chosen, tables = settings.tasks or list_tasks(), []
    for task in chosen:
        resolve_env(task, settings.env)  # before a table is begun
    for table, columns in COLUMNS.items():
        tasks = [task for task in chosen if _table_of(task) == table]
        cells = [(task, robot) for task in tasks for robot in settings.robots]
        rows = []
        for task, robot in tqdm(cells, unit="row", disable=not cells):
            envs = ({**env, **settings.env, "robot": robot} for env in columns.values())
            rows.append([f"`{task}`", robot, *(_cell(task, settings, env) for env in envs)])
            tqdm.write(" ".join(rows[-1]))
        if rows:
            tables.append("\n".join(pipes(("task", "robot", *columns), *rows)))
    text = "\n\n".join(tables)
    print(f"\n{text}\n\n{settings.episodes} episodes each, seed {settings.seed}")
    if settings.path is not None:
        write_text(settings.path, text + "\n")


def _table_of(task: str) -> str:
    """Return the key of a task's table."""
    group = task.split("/")[0]
    return group if group in COLUMNS else TASKS[task].control


def _cell(task: str, settings: Settings, env: dict[str, Any]) -> str:
    from ba_torchrl.demonstrations.collect import expert_scores

    workers = {"num_envs": settings.num_envs, "parallel": settings.parallel}
    try:
        scores = expert_scores(task, settings.episodes, seed=settings.seed, **workers, **env)
    except ConfigError as error:
        return f"not possible: {' '.join(str(error).split())}"
    if not scores.success_rate:
        return "0.000"
    lengths = f"{scores.mean_length:.1f} steps, median {scores.median_length:g}"
    return f"{scores.success_rate:.3f}, {lengths}"


COMMAND = Command(main, Settings, positional="tasks")
