"""List the tasks, describe some of them, or write the page of all.

ba-torchrl tasks
ba-torchrl tasks close_loop/block_picking
ba-torchrl tasks path=docs/tasks.md
"""

from __future__ import annotations

from collections.abc import Iterable

from ba_torchrl import describe, list_tasks
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import NewPath, PluginSettings, Tasks
from ba_torchrl.core.files import write_text
from ba_torchrl.envs.description import summary, tasks_by_heading
from ba_torchrl.tasks.base import TASKS


class Settings(PluginSettings):
    """Settings of this command."""

    tasks: Tasks = None
    """Ids of tasks; null for all."""
    path: NewPath | None = None
    """Write the page of the tasks, in Markdown, to this new file."""


def main(settings: Settings) -> None:
    """Print or write what is known of the tasks."""
    if settings.path is not None:
        tasks = [task for task in TASKS if TASKS.plugin_module(task) is None]
        print(write_text(settings.path, page(settings.tasks or tasks)))
    elif settings.tasks is not None:
        print("\n\n".join(str(describe(task)) for task in settings.tasks))
    else:
        for heading, tasks in tasks_by_heading(list_tasks()).items():
            print(f"{heading}:")
            for task in tasks:
                print(f"  {task:34} {summary(task)}")


def page(tasks: Iterable[str]) -> str:
    """Return a Markdown page with a section for each task."""
    lines = [
        "# Tasks",
        "",
        "Written by `ba-torchrl tasks path=...` from the sources. Success is the conjunction of",
        "the conditions in a valid scene at rest. `env.conditions` and Gymnasium's `info` hold",
        "them after every step. Rows with names in code are keywords of `ba_torchrl.make`, on the",
        "command line `env.max_steps=20`, with their default and in brackets what is allowed.",
    ]
    for heading, ids in tasks_by_heading(tasks).items():
        lines += ["", f"## {heading}"]
        for found in map(describe, ids):
            keywords = {"max_steps", "object_scale_range", "num_objects", *found.parameters}
            lines += ["", f"### `{found.task}`", "", found.text, ""]
            for name, value in found.rows().items():
                lines.append(f"- `{name}`: {value}" if name in keywords else f"- {name}: {value}")
    return "\n".join(lines) + "\n"


COMMAND = Command(main, Settings, positional="tasks")
