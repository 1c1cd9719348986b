"""Tables of finished runs, by benchmark, task and method.

Runs with different settings are not averaged; their methods get different names. The same holds
for runs that differ in what `POOLED` names.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.results import (
    NON_LEARNING_FIELDS,
    CurvePoint,
    RunResult,
    TestedPolicy,
    differences,
    flat,
    read_result,
    run_folders,
)
from ba_torchrl.record.statistics import (
    Estimate,
    area_under_success,
    mean_curve,
    mean_success,
    paired_difference,
    probability_of_improvement,
)

logger = logging.getLogger(__name__)

Axis = Literal["env_steps", "updates"]
Changes = Callable[[RunResult], Mapping[str, tuple[Any, Any]]]
"""From a run to the settings in which it differs from its benchmark: its value and the benchmark's,
by name."""
Completed = Callable[[RunResult], RunResult]
"""Fills in the defaults of settings that are newer than the run."""

POOLED = {
    "task version": lambda run: run.task_version,
    "expert version": lambda run: run.expert_version,
    "protocol": lambda run: run.protocol,
    "precision": lambda run: run.precision,
    "policy": lambda run: "of a run" if run.policy_file is None else "from a file",
}
"""What runs that are averaged have in common besides their settings, by name."""
_OF_METHODS = ("protocol", "precision", "policy")
"""Those by which methods are told apart on all tasks."""
GOOD_RATE = 0.8
"""Success rate of the mean curve for the measure of sample efficiency, steps to that rate."""
ENOUGH_SEEDS = 5
"""Least number of seeds of a comparison that is more than a direction."""
DIRECTION = "direction only"
ALL_TASKS = "all tasks"
OTHER_RUNS = "runs"
"""Title of the section of runs without a benchmark."""


@dataclass(frozen=True)
class Run:
    """A finished run and its folder, or the file of its result."""

    folder: Path
    result: RunResult


@dataclass(frozen=True)
class Group:
    """Runs that differ in their seed only."""

    task: str
    method: str
    runs: Sequence[Run]
    """Runs in the order of seeds."""

    @property
    def curves(self) -> list[list[CurvePoint]]:
        """Curves of all seeds that have one, of the same length.

        The last point of a run that ended at `stop_at_success` stands for all later ones. The
        untrained policy is left out if a run lacks its evaluation.
        """
        curves = [run.result.curve for run in self.runs]
        if any(curve and curve[0].updates for curve in curves):
            curves = [[point for point in curve if point.updates] for curve in curves]
        curves = [curve for curve in curves if curve] or [[]]
        length = max(map(len, curves))
        return [curve + curve[-1:] * (length - len(curve)) for curve in curves]

    def axis(self, name: Axis) -> np.ndarray:
        """Return updates or environment steps at the points of the longest run's curve, [n]."""
        longest = max(self.curves, key=lambda curve: curve[-1].updates if curve else 0)
        return np.array([getattr(point, name) for point in longest])

    @cached_property
    def curve(self) -> Estimate:
        """Mean success at the points of the curve, [n]."""
        rates, episodes = (
            np.array([[getattr(point, name) for point in curve] for curve in self.curves])
            for name in ("success_rate", "episodes")
        )
        return mean_curve(rates, episodes, np.random.default_rng(0))

    @cached_property
    def success(self) -> Estimate:
        """Mean success of the tests of the last policies."""
        return mean_success([self.tests], np.random.default_rng(0))

    @property
    def tests(self) -> list[TestedPolicy]:
        """Tests of the last policies."""
        return [run.result.last for run in self.runs]

    @property
    def by_seed(self) -> dict[int, TestedPolicy]:
        """Tests of the last policies by seed of the run."""
        return {run.result.seed: run.result.last for run in self.runs}

    @property
    def env_steps(self) -> int:
        """Environment steps at the last evaluation of the longest run."""
        return max((point.env_steps for curve in self.curves for point in curve), default=0)

    def area(self, end: int) -> float:
        """Return the mean over runs of the area under success over environment steps.

        Args:
            end: last step of all runs that are compared.
        """
        return _mean(
            area_under_success(
                [point.env_steps for point in curve], [point.success_rate for point in curve], end
            )
            for curve in self.curves
        )

    def reaches(self, rate: float) -> tuple[float, float]:
        """Return the updates and environment steps at which the mean curve reaches a rate.

        Both are nan if it does not. The resolution is the interval between evaluations.
        """
        reached = np.flatnonzero(self.curve.value >= rate)
        if not reached.size:
            return float("nan"), float("nan")
        steps = np.mean([curve[reached[0]].env_steps for curve in self.curves])
        return float(self.axis("updates")[reached[0]]), float(steps)


@dataclass(frozen=True)
class Section:
    """The runs of one benchmark, or all runs without a benchmark."""

    title: str
    groups: Sequence[Group]
    """In the order of tasks, then of methods."""
    changes: Mapping[str, set[tuple[str, str]]] = field(default_factory=dict)
    """Settings in which runs differ from the benchmark: pairs of the run's value and that of the
    benchmark, by name."""

    @property
    def tasks(self) -> list[str]:
        """Tasks in alphabetical order."""
        return sorted({group.task for group in self.groups})

    @property
    def methods(self) -> list[str]:
        """Methods in alphabetical order."""
        return sorted({group.method for group in self.groups})

    @property
    def not_pooled(self) -> list[str]:
        """Rows of a task and a label that differ in what `POOLED` names, and their folders."""
        alike: dict[tuple[str, str], list[Group]] = {}
        for group in self.groups:
            alike.setdefault((group.task, group.runs[0].result.label), []).append(group)
        return [
            f"{row.task}, {row.method}: {', '.join(str(run.folder) for run in row.runs)}"
            for rows in alike.values()
            if any(_pooled(row.runs[0]) != _pooled(rows[0].runs[0]) for row in rows)
            for row in rows
        ]


def load_runs(
    roots: Iterable[str | Path], completed: Completed = lambda run: run
) -> tuple[list[Run], list[Path]]:
    """Read every finished run below some folders, and the folders of unfinished runs.

    Folders with a damaged result are unfinished. Copies of a run are left out.

    Raises:
        FileNotFoundError: a folder is missing.
    """
    roots = [Path(root) for root in roots]
    for root in roots:
        if not root.is_dir():
            raise FileNotFoundError(f"there is no folder {root}")
    finished, unfinished = run_folders(roots)
    runs: list[Run] = []
    for folder in finished:
        try:
            run = Run(folder, completed(read_result(folder)))
        except ValueError as error:
            logger.warning("left out: %s", error)
            unfinished.append(folder)
            continue
        if copied := [other.folder for other in runs if other.result == run.result]:
            logger.warning("left out: %s is a copy of %s", folder, copied[0])
        else:
            runs.append(run)
    return runs, unfinished


def load_sections(
    roots: Sequence[str | Path],
    changes: Changes = lambda _: {},
    completed: Completed = lambda run: run,
) -> tuple[list[Section], list[Path]]:
    """Read every finished run below some folders.

    Return sections in the order of the benchmarks' names, runs without a benchmark last; and the
    folders of unfinished runs, those with a damaged result included. Runs whose settings are not
    those of their benchmark have a section of their own, "NAME, changed". Copies of a run are left
    out.

    Raises:
        FileNotFoundError: a folder is missing, or none holds a finished run.
        ConfigError: runs have the same settings and seed, and are no copies.
    """
    runs, unfinished = load_runs(roots, completed)
    if not runs:
        raise FileNotFoundError(
            f"no finished run below {', '.join(map(str, roots))}: "
            "a run leaves its result.json when it ends"
        )
    by_title: dict[str, list[Run]] = {}
    changed: dict[str, dict[str, set[tuple[str, str]]]] = {}
    for run in runs:
        title, found = run.result.benchmark or OTHER_RUNS, changes(run.result)
        title += ", changed" if found else ""
        by_title.setdefault(title, []).append(run)
        for name, (there, planned) in found.items():
            of_title = changed.setdefault(title, {})
            of_title.setdefault(name, set()).add((str(there), str(planned)))
    titles = sorted(by_title, key=lambda title: (title == OTHER_RUNS, title))
    sections = [Section(each, grouped(by_title[each]), changed.get(each, {})) for each in titles]
    return sections, unfinished


def grouped(runs: Iterable[Run]) -> list[Group]:
    """Group runs that differ in their seed only, in the order of tasks and methods.

    Methods with several settings get distinct names.

    Raises:
        ConfigError: runs have the same settings and seed.
    """
    named: dict[tuple[str, str], list[list[Run]]] = {}
    for run in runs:
        alike = named.setdefault((run.result.task, run.result.label), [])
        for group in alike:
            if not _differences(group[0], run):
                group.append(run)
                break
        else:
            alike.append([run])
    groups, twice = [], []
    for (task, label), alike in named.items():
        of_label = [
            group[0] for (_, name), other in named.items() if name == label for group in other
        ]
        for members in alike:
            seeds = [run.result.seed for run in members]
            where = [str(run.folder) for run in members if seeds.count(run.result.seed) > 1]
            twice += [f"{task}, {label}: {', '.join(where)}"] if where else []
            name = label + _distinction(members[0], [other[0] for other in alike], of_label)
            groups.append(Group(task, name, sorted(members, key=lambda run: run.result.seed)))
    if twice:
        raise ConfigError(
            f"runs with the same settings and seed: {'; '.join(twice)}; name the folders to report"
        )
    return sorted(groups, key=lambda group: (group.task, group.method))


def differing_settings(section: Section) -> list[tuple[str, str, str]]:
    """Return the settings in which methods differ on a task: name, value, and its methods."""
    names = set()
    for task in section.tasks:
        first, *others = (group.runs[0] for group in section.groups if group.task == task)
        names |= {name for other in others for name in _differences(first, other)}
    found: dict[tuple[str, str], set[str]] = {}
    for group in section.groups:
        settings = flat(_settings(group.runs[0]))
        for name in names:
            value = str(settings.get(name, "–"))
            found.setdefault((name, value), set()).add(group.method)
    return [(*key, ", ".join(sorted(found[key]))) for key in sorted(found)]


def summarize(section: Section) -> list[dict[str, Any]]:
    """Return the table of a section: numbers by name, nan where there is none.

    There is a row per task and method, and for each method that ran on every task a row in which
    the success is the mean over tasks.
    """
    ends = {
        task: max(group.env_steps for group in section.groups if group.task == task)
        for task in section.tasks
    }
    rows = [_row(section.title, group, ends[group.task]) for group in section.groups]
    if len(section.tasks) == 1:
        return rows
    for method, of_method in _on_all_tasks(section).items():
        own = [row for row in rows if row["method"] == method]
        success = mean_success([group.tests for group in of_method], np.random.default_rng(0))
        rows.append(
            {
                **dict.fromkeys(rows[0], float("nan")),
                "benchmark": section.title,
                "task": ALL_TASKS,
                "method": method,
                "seeds": min(row["seeds"] for row in own),
                "episodes": min(row["episodes"] for row in own),
                **_columns("success", success),
                **{name: _mean(row[name] for row in own) for name in ("best", "area", "hours")},
            }
        )
    return rows


def compare(section: Section) -> list[dict[str, Any]]:
    """Return the comparisons of the methods of a section: numbers by name, nan where there is none.

    There is a row per task and pair of methods, and a row of all tasks for each pair that ran on
    every task. Runs are paired by seed, test episodes by scene.
    """
    rows = []
    by_task = {
        task: {group.method: group for group in section.groups if group.task == task}
        for task in section.tasks
    }
    for task, groups in by_task.items():
        for first, second in itertools.combinations(groups.values(), 2):
            rows.append(_comparison(section.title, task, [(first, second)]))
    if len(section.tasks) > 1:
        for first, second in itertools.combinations(_on_all_tasks(section).values(), 2):
            pairs = list(zip(first, second, strict=True))
            rows.append(_comparison(section.title, ALL_TASKS, pairs))
    return rows


def _comparison(title: str, task: str, pairs: Sequence[tuple[Group, Group]]) -> dict[str, Any]:
    """Return the row of two methods on one task, or on all tasks."""
    nothing, seeds = Estimate(*[float("nan")] * 3), []
    difference = improvement = nothing
    obstacles = sorted({name for pair in pairs for name in _obstacles(*pair)})
    if not obstacles:
        tests, rates = [], []
        for first, second in pairs:
            shared = sorted(first.by_seed.keys() & second.by_seed.keys())
            seeds.append(len(shared))
            tests.append([[group.by_seed[seed] for seed in shared] for group in (first, second)])
            rates.append([[test.success_rate for test in group.tests] for group in (first, second)])
        difference = paired_difference(tests, np.random.default_rng(0))
        improvement = probability_of_improvement(rates, np.random.default_rng(0))
    least = min(seeds, default=0)
    first, second = pairs[0]
    return {
        "benchmark": title,
        "task": task,
        "first": first.method,
        "second": second.method,
        "seeds": least,
        **_columns("difference", difference),
        **_columns("improvement", improvement, "improvement_"),
        "reading": f"not compared: {', '.join(obstacles)}"
        if obstacles
        else DIRECTION
        if least < ENOUGH_SEEDS
        else "",
    }


def _obstacles(first: Group, second: Group) -> list[str]:
    """Return why two methods on a task are not compared."""
    found = [
        f"other {name}"
        for name in ("task version", "protocol")
        if POOLED[name](first.runs[0].result) != POOLED[name](second.runs[0].result)
    ]
    if len({tuple(test.seeds) for test in (*first.tests, *second.tests)}) > 1:
        found.append("other test episodes")
    if not first.by_seed.keys() & second.by_seed.keys():
        found.append("no seed in common")
    return found


def _on_all_tasks(section: Section) -> dict[str, list[Group]]:
    """Return the groups of each method that ran on every task, in the order of tasks."""
    found = {
        method: [group for group in section.groups if group.method == method]
        for method in section.methods
    }
    return {name: groups for name, groups in found.items() if len(groups) == len(section.tasks)}


def _row(title: str, group: Group, end: int) -> dict[str, Any]:
    """Return the row of a task and a method."""
    results = [run.result for run in group.runs]
    updates, steps = group.reaches(GOOD_RATE)
    hours = (
        float("nan") if result.seconds is None else result.seconds / 3600 for result in results
    )
    return {
        "benchmark": title,
        "task": group.task,
        "method": group.method,
        "seeds": len(results),
        "episodes": min(test.episodes for test in group.tests),
        **_columns("success", group.success),
        "best": _mean(result.best.success_rate for result in results),
        "area": group.area(end),
        "updates_to_80": updates,
        "env_steps_to_80": steps,
        "mean_length": _mean(test.mean_length for test in group.tests),
        "hours": _mean(hours),
    }


def _columns(name: str, found: Estimate, prefix: str = "") -> dict[str, float]:
    return {name: found.value, f"{prefix}low": found.low, f"{prefix}high": found.high}


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def _pooled(run: Run) -> dict[str, Any]:
    return {name: of(run.result) for name, of in POOLED.items()}


def _settings(run: Run) -> dict[str, Any]:
    return {**run.result.config, **_pooled(run)}


def _differences(first: Run, second: Run) -> dict[str, tuple[Any, Any]]:
    return differences(_settings(first), _settings(second), {*NON_LEARNING_FIELDS, "seed"})


def _distinction(run: Run, alike: Sequence[Run], of_label: Sequence[Run]) -> str:
    """Return what a run differs in from others as text, " (env.obs_size 64, protocol 1)".

    Args:
        alike: the first runs of the groups of its task and label.
        of_label: those of its label on all tasks.
    """
    names = {name for other in alike for name in _differences(run, other)}
    names |= {
        name
        for name in _OF_METHODS
        if any(POOLED[name](other.result) != POOLED[name](run.result) for other in of_label)
    }
    settings = flat(_settings(run))
    values = [f"{name} {settings.get(name)}" for name in sorted(names)]
    return f" ({', '.join(values)})" if values else ""
