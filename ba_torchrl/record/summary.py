"""Statistics over seeds of finished runs, by benchmark, task and method.

Runs with different settings are not averaged; their methods get different names.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import bootstrap

from ba_torchrl.record.results import (
    NON_LEARNING_FIELDS,
    CurvePoint,
    RunResult,
    differences,
    read_result,
    run_folders,
)

logger = logging.getLogger(__name__)

CONFIDENCE = 0.95
RESAMPLES = 9999
GOOD_RATE = 0.8
"""Success rate of the mean curve for the measure of sample efficiency, updates to that rate."""
ALL_TASKS = "all tasks"
OTHER_RUNS = "runs"
"""Title of the section of runs without a benchmark."""
COLUMNS = (
    "benchmark",
    "task",
    "method",
    "seeds",
    "success",
    "standard_error",
    "low",
    "high",
    "curve_mean",
    "updates_to_80",
    "env_steps_to_80",
    "mean_length",
    "hours",
)


@dataclass(frozen=True)
class Run:
    """A finished run and its folder."""

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
        """Curves of all seeds, of the same length.

        The last point of a run that ended at `stop_at_success` stands for all later ones.
        """
        curves = [run.result.curve for run in self.runs]
        length = max(map(len, curves))
        return [curve + curve[-1:] * (length - len(curve)) for curve in curves]

    @property
    def updates(self) -> np.ndarray:
        """Updates at the points of the curve, [n]."""
        longest = max((run.result.curve for run in self.runs), key=len)
        return np.array([point.updates for point in longest])

    @property
    def rates(self) -> np.ndarray:
        """Success rate of every seed at the points of the curve, [seeds, n]."""
        return np.array([[point.success_rate for point in curve] for curve in self.curves])

    @property
    def by_seed(self) -> dict[int, float]:
        """Success rate of the final evaluation by seed."""
        return {run.result.seed: run.result.final.success_rate for run in self.runs}

    @property
    def final(self) -> np.ndarray:
        """Success rates of the final evaluations, [seeds]."""
        return np.array(list(self.by_seed.values()))

    def reaches(self, rate: float) -> tuple[float, float]:
        """Return the updates and environment steps at which the mean curve reaches a rate.

        Both are nan if it does not. The resolution is the interval between evaluations.
        """
        reached = np.flatnonzero(self.rates.mean(0) >= rate)
        if not reached.size:
            return float("nan"), float("nan")
        points = [curve[reached[0]] for curve in self.curves]
        steps = np.mean([point.env_steps for point in points])
        return float(self.updates[reached[0]]), float(steps)


@dataclass(frozen=True)
class Section:
    """The runs of one benchmark, or all runs without a benchmark."""

    title: str
    groups: Sequence[Group]

    @property
    def tasks(self) -> list[str]:
        """Tasks in alphabetical order."""
        return sorted({group.task for group in self.groups})

    @property
    def methods(self) -> list[str]:
        """Methods in alphabetical order."""
        return sorted({group.method for group in self.groups})


def load_sections(roots: Iterable[str | Path]) -> tuple[list[Section], list[Path]]:
    """Read every finished run below some folders.

    Return sections in the order of the benchmarks' names, runs without a benchmark last; and the
    folders of unfinished runs, those with a damaged result included.

    Raises:
        FileNotFoundError: a folder is missing, or none holds a finished run.
        ValueError: a run is found twice.
    """
    roots = [Path(root) for root in roots]
    for root in roots:
        if not root.is_dir():
            raise FileNotFoundError(f"there is no folder {root}")
    finished, unfinished = run_folders(roots)
    runs = []
    for folder in finished:
        try:
            runs.append(Run(folder, read_result(folder)))
        except ValueError as error:
            logger.warning("left out: %s", error)
            unfinished.append(folder)
    if not runs:
        raise FileNotFoundError(
            f"no finished run below {', '.join(map(str, roots))}: "
            "a run leaves its result.json when it ends"
        )
    by_title: dict[str, list[Run]] = {}
    for run in runs:
        by_title.setdefault(run.result.benchmark or OTHER_RUNS, []).append(run)
    titles = sorted(by_title, key=lambda title: (title == OTHER_RUNS, title))
    return [Section(title, _grouped(by_title[title])) for title in titles], unfinished


def standard_error(values: np.ndarray) -> np.ndarray | float:
    """Return the standard error of the mean over the first axis; nan for a single value."""
    if len(values) < 2:
        return np.full(values.shape[1:], np.nan)[()]
    return values.std(axis=0, ddof=1) / np.sqrt(len(values))


def interval(values: np.ndarray) -> tuple[float, float]:
    """Return a bootstrap interval of the mean at `CONFIDENCE`; nan for a single value.

    With few seeds the interval tends to be too narrow.
    """
    if len(values) < 2:
        return float("nan"), float("nan")
    found = bootstrap(
        (values,),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(found.low), float(found.high)


def summarize(section: Section) -> list[dict[str, Any]]:
    """Return the table of a section: rows with the keys `COLUMNS`.

    There is a row per task and method, and for each method that ran on every task a row in which
    the success of a seed is the mean over tasks.
    """
    groups = sorted(section.groups, key=lambda group: (group.task, group.method))
    rows = [_row(section.title, group) for group in groups]
    if len(section.tasks) == 1:
        return rows
    for method in section.methods:
        of_method = [group for group in groups if group.method == method]
        shared = set.intersection(*(set(group.by_seed) for group in of_method))
        if len(of_method) < len(section.tasks) or not shared:
            continue
        final = np.array(
            [np.mean([group.by_seed[seed] for group in of_method]) for seed in sorted(shared)]
        )
        own = [row for row in rows if row["method"] == method and row["task"] != ALL_TASKS]
        low, high = interval(final)
        rows.append(
            {
                **dict.fromkeys(COLUMNS, float("nan")),
                "benchmark": section.title,
                "task": ALL_TASKS,
                "method": method,
                "seeds": len(shared),
                "success": float(final.mean()),
                "standard_error": float(standard_error(final)),
                "low": low,
                "high": high,
                "curve_mean": float(np.mean([row["curve_mean"] for row in own])),
                "hours": float(np.mean([row["hours"] for row in own])),
            }
        )
    return rows


def _row(title: str, group: Group) -> dict[str, Any]:
    """Return the row of a task and a method."""
    low, high = interval(group.final)
    updates, steps = group.reaches(GOOD_RATE)
    results = [run.result for run in group.runs]
    final, rates = group.final, group.rates
    values = [float(final.mean()), float(standard_error(final)), low, high]
    values += [float(rates.mean()) if rates.size else float("nan"), updates, steps]
    values.append(float(np.mean([result.final.mean_length for result in results])))
    values.append(float(np.mean([result.seconds for result in results])) / 3600)
    names = (title, group.task, group.method, len(group.runs))
    return dict(zip(COLUMNS, (*names, *values), strict=True))


def _grouped(runs: Sequence[Run]) -> list[Group]:
    """Group runs by task, method and settings; methods with several settings get distinct names."""
    named: dict[tuple[str, str], list[list[Run]]] = {}
    for run in runs:
        alike = named.setdefault((run.result.task, run.result.label), [])
        for group in alike:
            if not _differences(group[0], run):
                group.append(run)
                break
        else:
            alike.append([run])
    groups = []
    for (task, label), alike in named.items():
        for members in alike:
            seeds = [run.result.seed for run in members]
            twice = {seed for seed in seeds if seeds.count(seed) > 1}
            if twice:
                where = ", ".join(str(run.folder) for run in members if run.result.seed in twice)
                raise ValueError(f"{task}, {label}: runs with the same settings and seed: {where}")
            name = label + _distinction(members[0], [other[0] for other in alike])
            groups.append(Group(task, name, sorted(members, key=lambda run: run.result.seed)))
    return groups


def _differences(first: Run, second: Run) -> dict[str, tuple[Any, Any]]:
    return differences(first.result.config, second.result.config, {*NON_LEARNING_FIELDS, "seed"})


def _distinction(run: Run, others: Sequence[Run]) -> str:
    """Return the settings in which a run differs from others as text, " (env.obs_size 64)"."""
    names = sorted({name for other in others for name in _differences(run, other)})
    values = []
    for name in names:
        value: Any = run.result.config
        for part in name.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        values.append(f"{name} {value}")
    return f" ({', '.join(values)})" if values else ""
