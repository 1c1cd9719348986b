"""The table of measurements: its rows, their measurement and their output."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any, Literal

import torch
from tqdm import tqdm

from ba_torchrl.errors import ConfigError
from ba_torchrl.record.results import processor
from ba_torchrl.registry import Registry

GROUPS = ("simulation", "learning", "memory")

MEASUREMENTS: Registry[Measurement] = Registry("measurement", "ba_torchrl.profiling")

WARM_UP = 3
"""Calls before the first timed one, which allocate memory."""

PROFILE_ROWS = 40


@dataclass(frozen=True)
class Budget:
    """Values for comparison with a row, in the row's unit."""

    reference: str
    """The reference implementation's figure, on two cores of a Xeon with AMX."""
    must: float | None
    aim: float | None


@dataclass(frozen=True)
class Row:
    """A row of the table."""

    work: str
    unit: Literal["ms", "s", "MB"]
    values: Sequence[float]
    """All measurements, in `unit`."""
    budget: Budget | None = None
    multiple: float | None = None
    """Median as a multiple of the unit of work."""
    notes: str = ""


class Bench:
    """Repeats a measurement, and alternates timed calls with a unit of work.

    Args:
        repeats: rounds of each measurement.
        bar: progress bar of the rounds.
        profiles: receives a profile of each timed call, by name; None for no profiles.
    """

    def __init__(self, repeats: int, bar: tqdm, profiles: dict[str, str] | None = None) -> None:
        self.repeats = repeats
        self._bar = bar
        self._profiles = profiles

    def rounds(self) -> Iterator[int]:
        """Yield the number of each round."""
        for i in range(self.repeats):
            yield i
            self._bar.update()

    def time_against(
        self, unit: Callable[[], Any], calls: dict[str, Callable[[], Any]], repeats: int = 1
    ) -> tuple[list[float], dict[str, list[float]]]:
        """Time calls and a unit of work alternately; return the seconds of each.

        Args:
            unit: the unit of work.
            calls: the measured calls, by name.
            repeats: number of timed calls in a round.
        """
        for call in (unit, *calls.values()):
            for _ in range(WARM_UP):
                call()
        units: list[float] = []
        times: dict[str, list[float]] = {name: [] for name in calls}
        for _ in self.rounds():
            for _ in range(repeats):
                units.append(seconds(unit))
                for name, call in calls.items():
                    times[name].append(seconds(call))
        if self._profiles is not None:
            self._profiles.update({name: operations(call) for name, call in calls.items()})
        return units, times


def seconds(call: Callable[[], Any]) -> float:
    """Return the duration of a call, seconds."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def operations(call: Callable[[], Any]) -> str:
    """Return a table of the PyTorch operations of a call, by decreasing time over all threads."""
    with torch.profiler.profile(record_shapes=True) as profile:
        call()
    averages = profile.key_averages(group_by_input_shape=True)
    return averages.table(
        sort_by="self_cpu_time_total",
        row_limit=PROFILE_ROWS,
        max_name_column_width=44,
        max_shapes_column_width=88,
    )


@dataclass(frozen=True)
class Measurement:
    """A function that measures rows of the table, and the names for which it is called."""

    function: Callable[..., list[Row]]
    names: Callable[[], Iterable[str]] | None


def measurement(
    name: str, over: Callable[[], Iterable[str]] | None = None
) -> Callable[[Callable[..., list[Row]]], Callable[..., list[Row]]]:
    """Return a decorator that adds a function's rows to the table.

    Args:
        name: one of `GROUPS`, a slash, and the name of the measurement.
        over: returns names; the function is called once per name, as its second argument.
    """

    def decorate(function: Callable[..., list[Row]]) -> Callable[..., list[Row]]:
        MEASUREMENTS.register(name)(Measurement(function, over))
        return function

    return decorate


def measure(
    which: str, repeats: int, progress: bool = True, profiles: dict[str, str] | None = None
) -> list[Row]:
    """Measure one group of the table, a single measurement, or "all".

    Args:
        which: the group, or the measurement as "group/name".
        repeats: rounds of each measurement.
        progress: show a progress bar.
        profiles: receives a profile of each timed call, by name; None for no profiles.

    Raises:
        ConfigError: ``which`` is unknown, or ``repeats`` is below 1.
    """
    known = (*GROUPS, "all", *MEASUREMENTS)
    if which not in known:
        raise ConfigError(f"which: {which!r} is none of {', '.join(known)}")
    if repeats < 1:
        raise ConfigError(f"repeats must be 1 or more, got {repeats}")
    jobs = [
        (MEASUREMENTS[name].function, arguments)
        for group in GROUPS
        for name in MEASUREMENTS
        if name.startswith(f"{group}/") and which in (group, name, "all")
        for arguments in _arguments(MEASUREMENTS[name])
    ]
    rows: list[Row] = []
    with tqdm(total=len(jobs) * repeats, disable=not progress, unit="round") as bar:
        for function, arguments in jobs:
            rows += function(Bench(repeats, bar, profiles), *arguments)
    return rows


def _arguments(entry: Measurement) -> list[tuple[str, ...]]:
    return [()] if entry.names is None else [(name,) for name in entry.names()]


def timed_row(
    work: str,
    unit: Literal["ms", "s"],
    times: Sequence[float],
    units: Sequence[float],
    budget: Budget | None = None,
    notes: str = "",
) -> Row:
    """Return a row of measured times.

    Args:
        work: name of the timed work.
        unit: of the table.
        times: seconds of the work.
        units: seconds of the unit of work, timed alternately.
        budget: reference and limits.
        notes: remarks.
    """
    scale = {"ms": 1e3, "s": 1.0}[unit]
    multiple = statistics.median(times) / statistics.median(units)
    return Row(work, unit, [scale * value for value in times], budget, multiple, notes)


def as_markdown(rows: Sequence[Row]) -> str:
    """Return the rows as a table in Markdown."""
    lines = [
        "| work | median | mean | least | units | reference | must | aim | notes |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        budget = row.budget or Budget("", None, None)
        cells = [
            row.work,
            f"{_digits(statistics.median(row.values))} {row.unit}",
            _digits(statistics.fmean(row.values)),
            _digits(min(row.values)),
            _digits(row.multiple),
            budget.reference,
            _digits(budget.must),
            _digits(budget.aim),
            row.notes,
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _digits(value: float | None) -> str:
    """Return a number with three significant digits."""
    if value is None:
        return ""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def machine() -> str:
    """Return processor, package versions, date and load of the machine."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("torch", "torchrl", "pybullet"))
    load = f", load average {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return (
        f"{processor()}, {os.cpu_count()} cores, {torch.get_num_threads()} torch threads; "
        f"{packages}; {datetime.now(UTC):%Y-%m-%d}{load}"
    )
