"""Success by task and method, from the package's own records and from runs beside them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

from ba_torchrl.core.files import json_bytes
from ba_torchrl.record.results import CITABLE_EPISODES, RunResult
from ba_torchrl.record.summary import DIRECTION, ENOUGH_SEEDS, Completed, Group, Run, grouped
from ba_torchrl.tasks.base import TASKS

RECORDS = Path(str(files("ba_torchrl"))) / "results"
"""Folder of the package's records, a JSON file each."""
EMPTY = "–"
LEGEND = (
    "Success of the greedy last policy, or of that of a file, with its 95 % interval; seeds × test "
    f"episodes. *: fewer than {ENOUGH_SEEDS} seeds, {DIRECTION}."
)


@dataclass(frozen=True)
class Leaderboard:
    """Runs by task and method."""

    tasks: Sequence[str]
    methods: Sequence[str]
    cells: Mapping[tuple[str, str], Group]
    """By task and method; a pair without runs is missing."""
    left_out: Sequence[str]
    """Runs that do not belong to the table, and why."""

    def rows(self) -> list[list[str]]:
        """Return the heading and a row of texts for each task."""
        rows = [["task", *self.methods]]
        for task in self.tasks:
            cells = [self.cells.get((task, method)) for method in self.methods]
            rows.append([task, *(EMPTY if cell is None else cell_text(cell) for cell in cells)])
        return rows


def cell_text(group: Group) -> str:
    """Return success, interval, seeds and test episodes, "0.97 (0.95 to 0.98) 1×500*"."""
    value, low, high = group.success
    episodes = "/".join(map(str, sorted({test.episodes for test in group.tests})))
    mark = "*" if len(group.runs) < ENOUGH_SEEDS else ""
    return f"{value:.2f} ({low:.2f} to {high:.2f}) {len(group.runs)}×{episodes}{mark}"


def package_runs(completed: Completed = lambda run: run) -> list[Run]:
    """Read the package's records."""
    return read_records(RECORDS, completed)


def read_records(folder: Path, completed: Completed = lambda run: run) -> list[Run]:
    """Read the records in a folder, a JSON file each."""
    return [
        Run(path, completed(RunResult.model_validate_json(json_bytes(path))))
        for path in sorted(folder.glob("*.json"))
    ]


def leaderboard(
    packaged: Iterable[Run], own: Iterable[Run], tasks: Sequence[str], protocol: int
) -> Leaderboard:
    """Return the runs of some tasks, by task and method.

    Runs of other versions of the task or its expert, of another protocol, or with fewer test
    episodes than can be cited are left out. Own runs are not pooled with those of the package; a
    method of both has a second column.
    """
    left_out: list[str] = []
    shipped, beside = ([], [])
    for runs, kept in ((packaged, shipped), (own, beside)):
        for run in runs:
            why = _unfit(run.result, tasks, protocol)
            if why:
                name = f"{run.result.task}, {run.result.label}, seed {run.result.seed}"
                left_out.append(f"{name} ({run.folder}): {', '.join(why)}")
            elif all(run.result != other.result for other in shipped):
                kept.append(run)
    groups = grouped(shipped)
    taken = {group.method for group in groups}
    groups += [
        replace(group, method=f"{group.method}, own") if group.method in taken else group
        for group in grouped(beside)
    ]
    methods = sorted({group.method for group in groups})
    cells = {(group.task, group.method): group for group in groups}
    return Leaderboard(tasks, methods, cells, left_out)


def _unfit(result: RunResult, tasks: Sequence[str], protocol: int) -> list[str]:
    """Return why a run does not belong to the table."""
    if result.task not in tasks:
        return ["its task is not registered; name its plugins"]
    task = TASKS[result.task]
    present = {
        "task version": (result.task_version, (task.version,)),
        "expert version": (result.expert_version, (task.expert_version, None)),
        "protocol": (result.protocol, (protocol,)),
    }
    found = [
        f"{name} {there} instead of {allowed[0]}"
        for name, (there, allowed) in present.items()
        if there not in allowed
    ]
    if not result.last.is_citable:
        found.append(f"{result.last.episodes} test episodes, fewer than {CITABLE_EPISODES}")
    return found
