"""The documentation page of the tasks, generated from the registry."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ba_torchrl import describe
from ba_torchrl.tasks.base import TASKS

GENERAL_KEYWORDS = ("max_steps", "object_scale_range", "num_objects")
"""Rows of every task that are keywords of `ba_torchrl.make`."""


def task_page(tasks: Sequence[str] | None = None) -> str:
    """Return a Markdown page with a section for each task.

    Args:
        tasks: ids; all tasks of the package if None.
    """
    if tasks is None:
        tasks = [task for task in TASKS if TASKS.plugin_module(task) is None]
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
        for task in ids:
            lines += ["", *_section(task)]
    return "\n".join(lines) + "\n"


def _section(task: str) -> list[str]:
    """Return the lines of a task's section."""
    found = describe(task)
    keywords = {*GENERAL_KEYWORDS, *found.parameters}
    rows = (
        f"- `{name}`: {value}" if name in keywords else f"- {name}: {value}"
        for name, value in found.rows().items()
    )
    return [f"### `{task}`", "", found.text, "", *rows]


_SIX_DOF = "Six degrees of freedom: ramps, bumps"

HEADINGS = {
    "close_loop": "Close loop",
    "open_loop": "Open loop",
    "ramp": _SIX_DOF,
    "bump": _SIX_DOF,
}
"""Heading of each group of tasks, the part of their ids before the slash. The heading of a group
that is not listed, such as that of a plugin, is its name."""


def tasks_by_heading(tasks: Iterable[str]) -> dict[str, list[str]]:
    """Return the tasks of each heading: those of `HEADINGS` first, then others as they occur."""
    found: dict[str, list[str]] = {heading: [] for heading in HEADINGS.values()}
    for task in tasks:
        group = task.split("/")[0]
        found.setdefault(HEADINGS.get(group, group), []).append(task)
    return {heading: members for heading, members in found.items() if members}
