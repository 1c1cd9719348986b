"""Tables of finished runs, by benchmark, task and method.

Runs with different settings are not averaged; their methods get different names. The same holds
for runs that differ in what `POOLED` names.
"""

from __future__ import annotations

import itertools
import logging
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.results import (
    NON_LEARNING_FIELDS,
    CurvePoint,
    PolicyTest,
    RunResult,
    differences,
    flat,
    read_result,
    run_folders,
)
from ba_torchrl.record.statistics import (
    Estimate,
    area_under_success,
    mean_curve,
    mean_difference,
    mean_success,
    paired_difference,
)

logger = logging.getLogger(__name__)

Axis = Literal["env_steps", "updates"]
AXES: dict[Axis, str] = {"env_steps": "environment steps", "updates": "updates"}
"""In words."""
Changes = Callable[[RunResult], Mapping[str, tuple[Any, Any]]]
"""From a run to the settings in which it differs from its benchmark: its value and the benchmark's,
by name."""

POOLED: Mapping[str, Callable[[RunResult], object]] = {
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
LATE = 3
"""Number of evaluations whose mean is late success."""
ALL_TASKS = "all tasks"
OTHER_RUNS = "runs"
"""Title of the section of runs without a benchmark."""


@dataclass(frozen=True)
class Run:
    """A finished run and its folder, or the file of its result."""

    folder: Path
    result: RunResult

    @property
    def hours(self) -> float:
        """Wall time, nan of a policy from a file."""
        return math.nan if self.result.seconds is None else self.result.seconds / 3600

    @cached_property
    def settings(self) -> dict[str, Any]:
        """By dotted name, what affects learning in its configuration, and what `POOLED` names."""
        ignored = {*NON_LEARNING_FIELDS, "seed"}
        config = {name: each for name, each in self.result.config.items() if name not in ignored}
        return flat({**config, **{name: of(self.result) for name, of in POOLED.items()}})

    def differences(self, other: Run) -> dict[str, tuple[Any, Any]]:
        """Return the settings in which the runs differ, with both values."""
        return differences(self.settings, other.settings)


@dataclass(frozen=True)
class Group:
    """Runs that differ in their seed only."""

    task: str
    method: str
    runs: Sequence[Run]
    """Runs in the order of seeds."""

    @property
    def curves(self) -> list[list[CurvePoint]]:
        """Curves of all seeds that have one, of the same length; an empty one without any."""
        return list(self.curve_by_seed.values()) or [[]]

    @property
    def curve_by_seed(self) -> dict[int, list[CurvePoint]]:
        """Curves of all seeds that have one, of the same length.

        The last point of a run that ended at `stop_at_success` stands for all later ones. The
        untrained policy is left out if a run lacks its evaluation.
        """
        curves = {run.result.seed: run.result.curve for run in self.runs}
        if any(curve and curve[0].updates for curve in curves.values()):
            curves = {seed: [p for p in curve if p.updates] for seed, curve in curves.items()}
        length = max(map(len, curves.values()))
        return {
            seed: curve + curve[-1:] * (length - len(curve))
            for seed, curve in curves.items()
            if curve
        }

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
        return mean_curve(rates, episodes)

    @cached_property
    def success(self) -> Estimate:
        """Mean success of the tests of the last policies."""
        return mean_success([self.tests])

    @property
    def tests(self) -> list[PolicyTest]:
        """Tests of the last policies."""
        return [run.result.last for run in self.runs]

    @property
    def by_seed(self) -> dict[int, PolicyTest]:
        """Tests of the last policies by seed of the run."""
        return {run.result.seed: run.result.last for run in self.runs}

    def areas(self, axis: Axis, end: int) -> dict[int, float]:
        """Return the area under success over an axis, until ``end``, by seed of the run."""
        return {
            seed: area_under_success(
                [getattr(point, axis) for point in curve],
                [point.success_rate for point in curve],
                end,
            )
            for seed, curve in self.curve_by_seed.items()
        }

    def late(self) -> dict[int, float]:
        """Return the mean success of the last evaluations, `LATE`, by seed of the run."""
        return {
            seed: _mean(point.success_rate for point in curve[-LATE:])
            for seed, curve in self.curve_by_seed.items()
        }

    def reaches(self, rate: float) -> tuple[float, float]:
        """Return the updates and environment steps at which the mean curve reaches a rate.

        Both are nan if it does not. The resolution is the interval between evaluations.
        """
        reached = np.flatnonzero(self.curve.value >= rate)
        if not reached.size:
            return math.nan, math.nan
        steps = np.mean([curve[reached[0]].env_steps for curve in self.curves])
        return float(self.axis("updates")[reached[0]]), float(steps)


def axis_of(groups: Iterable[Group]) -> Axis:
    """Return environment steps, or updates if no run takes a step."""
    curves = (curve for group in groups for curve in group.curves)
    return "env_steps" if any(point.env_steps for curve in curves for point in curve) else "updates"


@dataclass(frozen=True)
class Section:
    """The runs of one benchmark, or all runs without a benchmark."""

    title: str
    groups: Sequence[Group]
    """In the order of tasks, then of methods."""
    changes: Sequence[str] = ()
    """Settings in which runs differ from the benchmark, as texts, "tau is 0.5 instead of 0.1"."""

    @property
    def tasks(self) -> list[str]:
        """Tasks in alphabetical order."""
        return sorted({group.task for group in self.groups})

    @property
    def methods(self) -> list[str]:
        """Methods in alphabetical order."""
        return sorted({group.method for group in self.groups})

    def of_task(self, task: str) -> list[Group]:
        """Return the groups of a task."""
        return [group for group in self.groups if group.task == task]

    def span(self, task: str) -> tuple[Axis, int]:
        """Return the axis of a task's areas, and its value at the last evaluation of all runs."""
        groups = self.of_task(task)
        axis = axis_of(groups)
        curves = (curve for group in groups for curve in group.curves)
        return axis, max((getattr(point, axis) for curve in curves for point in curve), default=0)

    def on_all_tasks(self) -> list[list[Group]]:
        """Return the groups of each method that ran on every task, in the order of tasks."""
        of_methods = ([g for g in self.groups if g.method == name] for name in self.methods)
        return [groups for groups in of_methods if len(groups) == len(self.tasks)]


def load_runs(roots: Iterable[str | Path]) -> tuple[list[Run], list[Path]]:
    """Read every finished run below some folders, and the folders of unfinished runs.

    Folders with a damaged result are unfinished. Copies of a run are left out.
    """
    finished, unfinished = run_folders(roots)
    runs: list[Run] = []
    for folder in finished:
        try:
            run = Run(folder, read_result(folder))
        except ValueError as error:
            logger.warning("left out: %s", error)
            unfinished.append(folder)
            continue
        if copied := [other.folder for other in runs if other.result == run.result]:
            logger.warning("left out: %s is a copy of %s", folder, copied[0])
        else:
            runs.append(run)
    return runs, unfinished


def sections(runs: Iterable[Run], changes: Changes = lambda _: {}) -> list[Section]:
    """Return runs in sections in the order of the benchmarks' names, those without one last.

    Runs whose settings are not those of their benchmark have a section of their own, "NAME,
    changed".

    Raises:
        ConfigError: runs have the same settings and seed.
    """
    by_title: dict[str, tuple[list[Run], set[str]]] = {}
    for run in runs:
        found = changes(run.result).items()
        title = (run.result.benchmark or OTHER_RUNS) + (", changed" if found else "")
        of_title, texts = by_title.setdefault(title, ([], set()))
        of_title.append(run)
        texts |= {f"{name} is {there} instead of {planned}" for name, (there, planned) in found}
    return [
        Section(title, grouped(by_title[title][0]), sorted(by_title[title][1]))
        for title in sorted(by_title, key=lambda title: (title == OTHER_RUNS, title))
    ]


def grouped(runs: Iterable[Run]) -> list[Group]:
    """Group runs that differ in their seed only, in the order of tasks and methods.

    Methods with several settings get distinct names.
    """
    by_method: dict[tuple[str, str], list[list[Run]]] = {}
    for run in runs:
        known = by_method.setdefault((run.result.task, run.result.label), [])
        equal = next((members for members in known if not run.differences(members[0])), None)
        if equal is None:
            known.append(equal := [])
        equal.append(run)
    alike = [members for known in by_method.values() for members in known]
    groups, twice = [], []
    for members in alike:
        result, seeds = members[0].result, [run.result.seed for run in members]
        where = [str(run.folder) for run in members if seeds.count(run.result.seed) > 1]
        twice += [f"{result.task}, {result.label}: {', '.join(where)}"] if where else []
        method = result.label + _distinction(members[0], [other[0] for other in alike])
        groups.append(Group(result.task, method, sorted(members, key=lambda run: run.result.seed)))
    if twice:
        raise ConfigError(
            f"runs with the same settings and seed: {'; '.join(twice)}; name the folders to report"
        )
    return sorted(groups, key=lambda group: (group.task, group.method))


def _distinction(run: Run, others: Sequence[Run]) -> str:
    """Return in what a run differs from the others of its label, " (tau 0.1, protocol 1)".

    Settings count on the run's task only, `_OF_METHODS` on all tasks.
    """
    names = set()
    for other in others:
        if other.result.label == run.result.label:
            differing = run.differences(other).keys()
            is_same_task = other.result.task == run.result.task
            names |= differing if is_same_task else differing & {*_OF_METHODS}
    values = [f"{name} {run.settings.get(name)}" for name in sorted(names)]
    return f" ({', '.join(values)})" if values else ""


def differing_settings(section: Section) -> list[dict[str, str]]:
    """Return the settings in which methods differ on a task: name, value, and its methods."""
    names = set()
    for task in section.tasks:
        first, *others = (group.runs[0] for group in section.of_task(task))
        names |= {name for other in others for name in first.differences(other)}
    found: dict[tuple[str, str], set[str]] = {}
    for group in section.groups:
        settings = group.runs[0].settings
        for name in names:
            found.setdefault((name, str(settings.get(name, "–"))), set()).add(group.method)
    return [
        {"setting": name, "value": value, "methods": ", ".join(sorted(found[name, value]))}
        for name, value in sorted(found)
    ]


def summarize(section: Section) -> list[dict[str, Any]]:
    """Return the table of a section: numbers by name, nan where there is none.

    There is a row per task and method, and for each method that ran on every task a row in which
    the success is the mean over tasks.
    """
    rows = [_row(section, group) for group in section.groups]
    for groups in section.on_all_tasks() if len(section.tasks) > 1 else ():
        own = [row for row in rows if row["method"] == groups[0].method]
        together = {
            "task": ALL_TASKS,
            **{name: min(row[name] for row in own) for name in ("seeds", "episodes")},
            **_columns("success", mean_success([group.tests for group in groups])),
            **{name: _mean(row[name] for row in own) for name in ("best", "area", "late", "hours")},
            **dict.fromkeys(("updates_to_80", "env_steps_to_80", "mean_length"), math.nan),
        }
        rows.append({**own[0], **together})
    return rows


def _row(section: Section, group: Group) -> dict[str, Any]:
    """Return the row of a task and a method."""
    updates, steps = group.reaches(GOOD_RATE)
    return {
        "benchmark": section.title,
        "task": group.task,
        "method": group.method,
        "seeds": len(group.runs),
        "episodes": min(test.episodes for test in group.tests),
        **_columns("success", group.success),
        "best": _mean(run.result.best.success_rate for run in group.runs),
        "area": _mean(group.areas(*section.span(group.task)).values()),
        "late": _mean(group.late().values()),
        "updates_to_80": updates,
        "env_steps_to_80": steps,
        "mean_length": _mean(test.mean_length for test in group.tests),
        "hours": _mean(run.hours for run in group.runs),
    }


def compare(section: Section) -> list[dict[str, Any]]:
    """Return the comparisons of the methods of a section: numbers by name, nan where there is none.

    There is a row per task and pair of methods, and a row of all tasks for each pair that ran on
    every task. Runs are paired by seed, test episodes by scene. "difference" is of the tests of the
    last policies, "area" and "late" are the differences of these measures; the reading names
    settings besides algorithm and network in which the runs differ, unless they are what the
    methods' names differ in.
    """
    rows = [
        _comparison(section, task, [pair])
        for task in section.tasks
        for pair in itertools.combinations(section.of_task(task), 2)
    ]
    if len(section.tasks) > 1:
        for first, second in itertools.combinations(section.on_all_tasks(), 2):
            pairs = list(zip(first, second, strict=True))
            rows.append(_comparison(section, ALL_TASKS, pairs))
    return rows


def _comparison(
    section: Section, task: str, pairs: Sequence[tuple[Group, Group]]
) -> dict[str, Any]:
    """Return the row of two methods on one task, or on all tasks."""
    difference = area = late = Estimate(math.nan, math.nan, math.nan)
    least = 0
    if obstacles := sorted({name for pair in pairs for name in _obstacles(*pair)}):
        reading = f"not compared: {', '.join(obstacles)}"
    else:
        tests = []
        for pair in pairs:
            seeds = sorted(pair[0].by_seed.keys() & pair[1].by_seed.keys())
            tests.append([[group.by_seed[seed] for seed in seeds] for group in pair])
        least = min(len(first) for first, _ in tests)
        difference = paired_difference(tests)
        area = _difference(
            [[group.areas(*section.span(group.task)) for group in pair] for pair in pairs]
        )
        late = _difference([[group.late() for group in pair] for pair in pairs])
        notes = [DIRECTION] if least < ENOUGH_SEEDS else []
        if names := sorted({name for pair in pairs for name in _beside(*pair)}):
            notes.append(f"also differ in {', '.join(names)}")
        reading = "; ".join(notes)
    return {
        "benchmark": section.title,
        "task": task,
        "first": pairs[0][0].method,
        "second": pairs[0][1].method,
        "seeds": least,
        **_columns("difference", difference),
        **_columns("area", area, "area_"),
        **_columns("late", late, "late_"),
        "reading": reading,
    }


def _difference(pairs: Sequence[Sequence[Mapping[int, float]]]) -> Estimate:
    """Return the difference of a measure, first minus second, over tasks and common seeds.

    Args:
        pairs: of each task, the measure of both methods by seed.
    """
    common = set.intersection(*(set(values) for pair in pairs for values in pair))
    found = [_mean(pair[0][seed] - pair[1][seed] for pair in pairs) for seed in sorted(common)]
    return mean_difference(found)


def _beside(first: Group, second: Group) -> Iterator[str]:
    """Yield the settings besides algorithm and network in which two methods differ.

    Those of methods whose labels have the same algorithm and network, and that differ in a variant
    of both, are what is compared.
    """
    if first.runs[0].result.label.split()[:2] != second.runs[0].result.label.split()[:2]:
        for name in first.runs[0].differences(second.runs[0]):
            if name.partition(".")[0] not in ("algorithm", "network", *POOLED):
                yield name


def _obstacles(first: Group, second: Group) -> list[str]:
    """Return why two methods on a task are not compared."""
    differing = first.runs[0].differences(second.runs[0])
    found = [f"other {name}" for name in ("task version", "protocol") if name in differing]
    if len({tuple(test.seeds) for test in (*first.tests, *second.tests)}) > 1:
        found.append("other test episodes")
    if not first.by_seed.keys() & second.by_seed.keys():
        found.append("no seed in common")
    return found


def pipes(header: Sequence[str], *rows: Sequence[str]) -> list[str]:
    """Return the lines of a table in Markdown; see `markdown` for its cells."""
    rule = ["---"] * len(header)
    return [f"| {' | '.join(map(markdown, row))} |" for row in (header, rule, *rows)]


def markdown(text: str) -> str:
    """Return a text as one line of Markdown that makes no HTML, no link and no cell of a table."""
    return re.sub(r"[\\|<]|\](?=[(\[])", r"\\\g<0>", printable(text))


def printable(text: str) -> str:
    """Return a text as one line, with spaces in place of characters that cannot be printed."""
    return "".join(c if c.isprintable() or c == "\N{NO-BREAK SPACE}" else " " for c in text)


def _columns(name: str, found: Estimate, prefix: str = "") -> dict[str, float]:
    return {name: found.value, f"{prefix}low": found.low, f"{prefix}high": found.high}


def _mean(values: Iterable[float]) -> float:
    found = list(values)
    return float(np.mean(found)) if found else math.nan
