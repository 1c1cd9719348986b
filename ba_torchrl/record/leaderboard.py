"""Success by task and method, from the shipped policies' results and from runs beside them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ba_torchrl.record.results import (
    CITABLE_EPISODES,
    POLICIES,
    POLICY_SUFFIX,
    RunResult,
    read_result,
)
from ba_torchrl.record.summary import DIRECTION, ENOUGH_SEEDS, Group, Run, grouped
from ba_torchrl.tasks.base import TASKS

_SUFFIXES = (POLICY_SUFFIX, ".json")
EMPTY = "–"
LEGEND = (
    "Success of the greedy last policy, or of that of a file, with its 95 % interval; seeds × test "
    f"episodes. *: fewer than {ENOUGH_SEEDS} seeds, {DIRECTION}."
)


@dataclass(frozen=True)
class Leaderboard:
    """Runs by task and method."""

    tasks: Sequence[str]
    groups: Sequence[Group]
    """In the order of tasks, then of methods."""
    left_out: Sequence[str]
    """Runs that do not belong to the table, and why."""

    def of_task(self, task: str) -> list[Group]:
        """Return the groups of a task."""
        return [group for group in self.groups if group.task == task]

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """Yield the heading, and a row for each method of each task; one of dashes without any."""
        yield "task", "method", "success"
        for task in self.tasks:
            groups = self.of_task(task)
            yield from ((task, group.method, success_text(group)) for group in groups)
            if not groups:
                yield task, EMPTY, EMPTY


def success_text(group: Group) -> str:
    """Return success, interval, seeds and test episodes, "0.97 (0.95 to 0.98) 1×500*"."""
    value, low, high = group.success
    episodes = "/".join(map(str, sorted({test.episodes for test in group.tests})))
    mark = "*" if len(group.runs) < ENOUGH_SEEDS else ""
    return f"{value:.2f} ({low:.2f} to {high:.2f}) {len(group.runs)}×{episodes}{mark}"


def read_results(folder: Path | None = None) -> list[Run]:
    """Read the results in the files below a folder, by default those of the shipped policies."""
    files = sorted((folder or POLICIES).rglob("*.*"))
    return [Run(file, read_result(file)) for file in files if file.suffix in _SUFFIXES]


def leaderboard(
    packaged: Iterable[Run], own: Iterable[Run], tasks: Sequence[str], protocol: int
) -> Leaderboard:
    """Return the runs of some tasks, by task and method.

    Runs of other versions of the task or its expert, of another protocol, or with fewer test
    episodes than can be cited are left out. Own runs are not pooled with those of the package; a
    method of both has a second name.
    """
    left_out: list[str] = []
    shipped: list[Run] = []
    beside: list[Run] = []
    for runs, kept in ((packaged, shipped), (own, beside)):
        for run in runs:
            result = run.result
            if why := _unfit(result, tasks, protocol):
                name = f"{result.task}, {result.label}, seed {result.seed} ({run.folder})"
                left_out.append(f"{name}: {', '.join(why)}")
            elif all(result != other.result for other in shipped):
                kept.append(run)
    groups = grouped(shipped)
    taken = {group.method for group in groups}
    groups += [
        replace(group, method=f"{group.method}, own") if group.method in taken else group
        for group in grouped(beside)
    ]
    return Leaderboard(tasks, sorted(groups, key=lambda each: (each.task, each.method)), left_out)


def _unfit(result: RunResult, tasks: Sequence[str], protocol: int) -> list[str]:
    """Return why a run does not belong to the table."""
    if result.task not in tasks:
        return ["its task is not registered; name its plugins"]
    task = TASKS[result.task]
    numbers = [
        ("task version", result.task_version, task.version),
        ("expert version", result.expert_version, task.expert_version),
        ("protocol", result.protocol, protocol),
    ]
    found = [
        f"{name} {there} instead of {now}"
        for name, there, now in numbers
        if there not in (now, None)
    ]
    if not result.last.is_citable:
        found.append(f"{result.last.episodes} test episodes, fewer than {CITABLE_EPISODES}")
    return found
