"""Statistics over seeds of finished runs, by benchmark, task and method.

Runs with different settings are not averaged; their methods get different names. Success rates are
summarized by their interquartile mean (IQM) with a stratified bootstrap (Agarwal et al., 2021).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ba_torchrl.errors import ConfigError, MissingPackageError, install_command
from ba_torchrl.record.results import (
    NON_LEARNING_FIELDS,
    CurvePoint,
    RunResult,
    TestedPolicy,
    differences,
    flat,
    read_result,
    run_folders,
    wilson_interval,
)

logger = logging.getLogger(__name__)

Axis = Literal["updates", "env_steps"]
Changes = Callable[[RunResult], Mapping[str, tuple[Any, Any]]]
"""From a run to the settings in which it differs from its benchmark: its value and the benchmark's,
by name."""
Completed = Callable[[RunResult], RunResult]
"""Fills in the defaults of settings that are newer than the run."""

CONFIDENCE = 0.95
RESAMPLES = 2000
GOOD_RATE = 0.8
"""Success rate of the IQM's curve for the measure of sample efficiency, updates to that rate."""
ENOUGH_SEEDS = 5
"""Least number of seeds from which intervals over seeds are reported without a warning."""
ALL_TASKS = "all tasks"
OTHER_RUNS = "runs"
"""Title of the section of runs without a benchmark."""


@dataclass(frozen=True)
class Estimate:
    """Interquartile means and their intervals at `CONFIDENCE`, each [n]."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


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

        The last point of a run that ended at `stop_at_success` stands for all later ones. The
        untrained policy is left out if a run lacks its evaluation.
        """
        curves = [run.result.curve for run in self.runs]
        if any(curve and curve[0].updates for curve in curves):
            curves = [[point for point in curve if point.updates] for curve in curves]
        length = max(map(len, curves))
        return [curve + curve[-1:] * (length - len(curve)) for curve in curves]

    def axis(self, name: Axis) -> np.ndarray:
        """Return updates or environment steps at the points of the longest run's curve, [n]."""
        longest = max(self.curves, key=lambda curve: curve[-1].updates if curve else 0)
        return np.array([getattr(point, name) for point in longest])

    @cached_property
    def estimate(self) -> Estimate:
        """Success at the points of the curve and, last, in the final evaluation, [n + 1]."""
        points = [
            [*curve, run.result.last] for curve, run in zip(self.curves, self.runs, strict=True)
        ]
        rates = np.array([[[point.success_rate for point in curve]] for curve in points])
        episodes = np.array([[[point.episodes for point in curve]] for curve in points])
        return estimate(rates, episodes)

    @property
    def by_seed(self) -> dict[int, TestedPolicy]:
        """Final evaluations by seed."""
        return {run.result.seed: run.result.last for run in self.runs}

    def reaches(self, rate: float) -> tuple[float, float]:
        """Return the updates and environment steps at which the IQM's curve reaches a rate.

        Both are nan if it does not. The resolution is the interval between evaluations.
        """
        reached = np.flatnonzero(self.estimate.value[:-1] >= rate)
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


def load_sections(
    roots: Iterable[str | Path],
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
    roots = [Path(root) for root in roots]
    for root in roots:
        if not root.is_dir():
            raise FileNotFoundError(f"there is no folder {root}")
    finished, unfinished = run_folders(roots)
    runs = []
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
    sections = [Section(each, _grouped(by_title[each]), changed.get(each, {})) for each in titles]
    return sections, unfinished


def estimate(rates: np.ndarray, episodes: np.ndarray) -> Estimate:
    """Return the interquartile mean of success rates over seeds and tasks, with its interval.

    The interval is that of a bootstrap over seeds, stratified by task. Where all rates are equal,
    as that of a single run is, it is Wilson's over the episodes of all. Where rates differ between
    tasks and not between seeds, it is nan.

    Args:
        rates: [seeds, tasks, n].
        episodes: number behind each rate, [seeds, tasks, n].

    Raises:
        MissingPackageError: rates differ between seeds, and rliable is missing.
    """
    value, total = _iqm(rates), episodes.sum((0, 1))
    interval = np.full((2, value.size), np.nan)
    for point in np.flatnonzero((rates == rates[:1, :1]).all((0, 1))):
        successes = round(rates[0, 0, point] * total[point])
        interval[:, point] = wilson_interval(successes, int(total[point]))
    varies = (rates != rates[:1]).any((0, 1))
    if varies.any():
        interval[:, varies] = _bootstrap(rates[..., varies])
    return Estimate(value, *interval)


def _iqm(rates: np.ndarray) -> np.ndarray:
    """Return the mean of the middle half of all rates, [seeds, tasks, n] -> [n].

    It is `scipy.stats.trim_mean` of 25 %, which takes thirteen times as long.
    """
    ordered = np.sort(rates.reshape(-1, rates.shape[-1]), axis=0)
    cut = len(ordered) // 4
    return ordered[cut : len(ordered) - cut].mean(0)


def _bootstrap(rates: np.ndarray) -> np.ndarray:
    """Return the interval of the interquartile mean, [seeds, tasks, n] -> [2, n]."""
    try:
        from rliable.library import get_interval_estimates
    except (ImportError, TypeError) as error:  # the latter from arch, if pandas is version 3
        fix = install_command("rliable", "pandas<3")
        raise MissingPackageError(
            f"intervals over several seeds need the extra [report]: {fix}"
        ) from error
    state = np.random.get_state()  # noqa: NPY002, rliable draws from the global generator
    np.random.seed(0)  # noqa: NPY002
    try:
        _, found = get_interval_estimates(
            {"": rates}, _iqm, reps=RESAMPLES, confidence_interval_size=CONFIDENCE
        )
    finally:
        np.random.set_state(state)  # noqa: NPY002
    return found[""]


def differing_settings(section: Section) -> list[tuple[str, str, str]]:
    """Return the settings in which methods differ on a task: name, value, and its methods."""
    names = set()
    for task in section.tasks:
        first, *others = (group.runs[0] for group in section.groups if group.task == task)
        names |= {name for other in others for name in _differences(first, other)}
    found: dict[tuple[str, str], set[str]] = {}
    for group in section.groups:
        settings = flat(group.runs[0].result.config)
        for name in names:
            value = str(settings.get(name, "–"))
            found.setdefault((name, value), set()).add(group.method)
    return [(*key, ", ".join(sorted(found[key]))) for key in sorted(found)]


def summarize(section: Section) -> list[dict[str, Any]]:
    """Return the table of a section: numbers by name, nan where there is none.

    There is a row per task and method, and for each method that ran on every task a row in which
    the success is that over seeds and tasks.
    """
    rows = [_row(section.title, group) for group in section.groups]
    if len(section.tasks) == 1:
        return rows
    for method in section.methods:
        of_method = [group for group in section.groups if group.method == method]
        shared = set.intersection(*(set(group.by_seed) for group in of_method))
        if len(of_method) < len(section.tasks) or not shared:
            continue
        final = [[group.by_seed[seed] for group in of_method] for seed in sorted(shared)]
        rates = np.array([[[each.success_rate] for each in row] for row in final])
        episodes = np.array([[[each.episodes] for each in row] for row in final])
        own = [row for row in rows if row["method"] == method and row["task"] != ALL_TASKS]
        rows.append(
            {
                **dict.fromkeys(rows[0], float("nan")),
                "benchmark": section.title,
                "task": ALL_TASKS,
                "method": method,
                "seeds": len(shared),
                **_success(estimate(rates, episodes), rates),
                "curve_mean": float(np.mean([row["curve_mean"] for row in own])),
                "hours": float(np.mean([row["hours"] for row in own])),
            }
        )
    return rows


def _row(title: str, group: Group) -> dict[str, Any]:
    """Return the row of a task and a method."""
    results = [run.result for run in group.runs]
    updates, steps = group.reaches(GOOD_RATE)
    curves = [point.success_rate for curve in group.curves for point in curve if point.updates]
    return {
        "benchmark": title,
        "task": group.task,
        "method": group.method,
        "seeds": len(results),
        **_success(group.estimate, np.array([result.last.success_rate for result in results])),
        "curve_mean": float(np.mean(curves)) if curves else float("nan"),
        "updates_to_80": updates,
        "env_steps_to_80": steps,
        "mean_length": float(np.mean([result.last.mean_length for result in results])),
        "hours": float(np.mean([result.seconds for result in results])) / 3600,
    }


def _success(found: Estimate, rates: np.ndarray) -> dict[str, float]:
    """Return the columns on the final evaluations."""
    names = ("success_iqm", "low", "high")
    values = (found.value[-1], found.low[-1], found.high[-1])
    return {
        **dict(zip(names, map(float, values), strict=True)),
        "success_mean": float(rates.mean()),
    }


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
                raise ConfigError(
                    f"{task}, {label}: runs with the same settings and seed: {where}; name the "
                    "folders to report"
                )
            name = label + _distinction(members[0], [other[0] for other in alike])
            groups.append(Group(task, name, sorted(members, key=lambda run: run.result.seed)))
    return sorted(groups, key=lambda group: (group.task, group.method))


def _differences(first: Run, second: Run) -> dict[str, tuple[Any, Any]]:
    return differences(first.result.config, second.result.config, {*NON_LEARNING_FIELDS, "seed"})


def _distinction(run: Run, others: Sequence[Run]) -> str:
    """Return the settings in which a run differs from others as text, " (env.obs_size 64)"."""
    names = sorted({name for other in others for name in _differences(run, other)})
    settings = flat(run.result.config)
    values = [f"{name} {settings.get(name)}" for name in names]
    return f" ({', '.join(values)})" if values else ""
