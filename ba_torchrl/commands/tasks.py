"""List the tasks, describe some of them, or write the page of all.

ba-torchrl tasks
ba-torchrl tasks close_loop/block_picking
ba-torchrl tasks path=docs/tasks.md overwrite=true
"""

from __future__ import annotations

from pathlib import Path

from ba_torchrl import describe, list_tasks
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import OutputFile, PluginSettings, Tasks, check_untracked
from ba_torchrl.core.files import write_text
from ba_torchrl.envs.description import summary
from ba_torchrl.record.task_page import task_page, tasks_by_heading


class Settings(PluginSettings):
    """Settings of this command."""

    tasks: Tasks = None
    """Ids of tasks; null for all."""
    path: OutputFile | None = None
    """Write the page of the tasks, in Markdown, to this file."""
    overwrite: bool = False
    """Also write over a file that git tracks."""


def main(settings: Settings) -> None:
    """Print or write what is known of the tasks."""
    if settings.path is not None:
        path = Path(settings.path)
        if not settings.overwrite:
            check_untracked([path])
        print(write_text(path, task_page(settings.tasks)))
    elif settings.tasks is not None:
        print("\n\n".join(str(describe(task)) for task in settings.tasks))
    else:
        for heading, tasks in tasks_by_heading(list_tasks()).items():
            print(f"{heading}:")
            for task in tasks:
                print(f"  {task:34} {summary(task)}")


COMMAND = Command(main, Settings, positional="tasks")
