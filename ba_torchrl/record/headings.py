"""Headings under which figures and pages list the tasks."""

from __future__ import annotations

from collections.abc import Iterable

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
    """Return the tasks of each heading: those of `HEADINGS` first, then the others as they occur.

    Args:
        tasks: ids.
    """
    found: dict[str, list[str]] = {heading: [] for heading in HEADINGS.values()}
    for task in tasks:
        group = task.split("/")[0]
        found.setdefault(HEADINGS.get(group, group), []).append(task)
    return {heading: members for heading, members in found.items() if members}
