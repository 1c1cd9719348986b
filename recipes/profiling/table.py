"""The table of measurements: its rows, their measurement and their output."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass as validated
from tqdm import tqdm

from ba_torchrl.algorithms.compilation import CompileMode
from ba_torchrl.core.config import StrictModel
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.registry import Registry
from ba_torchrl.modules.layers import Precision

GROUPS = ("simulation", "learning", "throughput", "memory")

MEASUREMENTS: Registry[Measurement] = Registry("measurement", "profiling")

WARM_UP = 3
"""Calls before the first timed one, which allocate memory."""

PROFILE_ROWS = 40

CPU = torch.device("cpu")


Unit = Literal["ms", "s", "MB", "frames/s"]
SECONDS = {"ms": 1e-3, "s": 1.0}
"""Units of duration."""

Positive = Annotated[float, Field(gt=0)]
Values = Annotated[tuple[Positive, ...], Field(strict=False)]  # lists become tuples


@validated(config=StrictModel.model_config)
class Budget:
    """Values for comparison with a row, in the row's unit."""

    reference: str
    """The reference implementation's figure, on two cores of a Xeon."""
    must: Positive | None
    aim: Positive | None


@validated(config=StrictModel.model_config)
class Row:
    """A row of the table."""

    work: str
    unit: Unit
    values: Annotated[Values, Field(min_length=1)]
    """All measurements, in `unit`."""
    budget: Budget | None = None
    unit_s: Values = ()
    """Seconds of the unit of work, timed alternately with the values."""
    limit_s: Values = ()
    """Seconds that the row's multiply-adds take in a matrix product, timed alternately."""
    notes: str = ""

    @property
    def multiple(self) -> float | None:
        """Median duration in units of work, or frames during a unit; None without a unit."""
        if not self.unit_s:
            return None
        value, unit_s = statistics.median(self.values), statistics.median(self.unit_s)
        return value * SECONDS[self.unit] / unit_s if self.unit in SECONDS else value * unit_s

    @property
    def share_of_limit(self) -> float | None:
        """Median duration of the matrix product as a fraction of the row's; None without."""
        if not self.limit_s:
            return None
        median_s = statistics.median(self.values) * SECONDS[self.unit]
        return statistics.median(self.limit_s) / median_s


class Bench:
    """Repeats a measurement, and alternates timed calls with units of work.

    Args:
        repeats: rounds of each measurement.
        bar: progress bar of the rounds.
        profiles: receives a profile of each timed call, by name; None for no profiles.
        device: of the learners.
        precision: of the learners' networks.
        compile_mode: of the learners, see `ExperimentConfig`.
    """

    def __init__(
        self,
        repeats: int,
        bar: tqdm,
        profiles: dict[str, str] | None = None,
        device: torch.device = CPU,
        precision: Precision = "auto",
        compile_mode: CompileMode | None = None,
    ) -> None:
        self.repeats = repeats
        self.device = device
        self.precision: Precision = precision
        self.compile_mode: CompileMode | None = compile_mode
        self._bar = bar
        self._profiles = profiles

    def rounds(self) -> Iterator[int]:
        """Yield the number of each round."""
        for i in range(self.repeats):
            yield i
            self._bar.update()

    def time_against(
        self,
        units: Mapping[str, Callable[[], Any]],
        calls: Mapping[str, Callable[[], Any]],
        repeats: int = 1,
    ) -> dict[str, list[float]]:
        """Time calls and units of work alternately; return the seconds of each, by name.

        Args:
            units: the units of work, by name; they are not profiled.
            calls: the measured calls, by name.
            repeats: number of timed calls in a round.
        """
        timed = {**units, **calls}
        for call in timed.values():
            for _ in range(WARM_UP):
                call()
        times: dict[str, list[float]] = {name: [] for name in timed}
        for _ in self.rounds():
            for _ in range(repeats):
                for name, call in timed.items():
                    times[name].append(seconds(call, self.device))
        if self._profiles is not None:
            self._profiles.update({name: operations(call) for name, call in calls.items()})
        return times


def seconds(call: Callable[[], Any], device: torch.device = CPU) -> float:
    """Return the duration of a call, seconds.

    Args:
        call: the timed function.
        device: where it computes; its work ends within the measured time.
    """
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda _: None
    wait(device)
    start = time.perf_counter()
    call()
    wait(device)
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
    """A function that measures rows of the table, and the arguments for which it is called."""

    function: Callable[..., list[Row]]
    over: Callable[[], Iterable[tuple[Any, ...]]]


def measurement(
    name: str, over: Callable[[], Iterable[tuple[Any, ...]]] = lambda: [()]
) -> Callable[[Callable[..., list[Row]]], Callable[..., list[Row]]]:
    """Return a decorator that adds a function's rows to the table.

    Args:
        name: one of `GROUPS`, a slash, and the name of the measurement.
        over: returns tuples; the function is called once per tuple, which holds its arguments after
            the first.
    """

    def decorate(function: Callable[..., list[Row]]) -> Callable[..., list[Row]]:
        MEASUREMENTS.register(name)(Measurement(function, over))
        return function

    return decorate


def measure(which: str, repeats: int, progress: bool = True, **options: Any) -> list[Row]:
    """Measure one group of the table, a single measurement, or "all".

    Args:
        which: the group, or the measurement as "group/name".
        repeats: rounds of each measurement, 1 or more.
        progress: show a progress bar.
        options: of `Bench`.

    Raises:
        ConfigError: ``which`` is unknown.
    """
    known = (*GROUPS, "all", *MEASUREMENTS)
    if which not in known:
        raise ConfigError(f"which: {which!r} is none of {', '.join(known)}")
    jobs = [
        (MEASUREMENTS[name].function, arguments)
        for group in GROUPS
        for name in MEASUREMENTS
        if name.startswith(f"{group}/") and which in (group, name, "all")
        for arguments in MEASUREMENTS[name].over()
    ]
    rows: list[Row] = []
    with tqdm(total=len(jobs) * repeats, disable=not progress, unit="round") as bar:
        for function, arguments in jobs:
            rows += function(Bench(repeats, bar, **options), *arguments)
    return rows


def timed_row(
    work: str,
    unit: Literal["ms", "s"],
    times: Sequence[float],
    units: Sequence[float],
    budget: Budget | None = None,
    notes: str = "",
    limits: Sequence[float] = (),
) -> Row:
    """Return a row of measured times.

    Args:
        work: name of the timed work.
        unit: of the table.
        times: seconds of the work.
        units: seconds of the unit of work, timed alternately.
        budget: reference and limits.
        notes: remarks.
        limits: seconds of the work's multiply-adds in a matrix product, timed alternately.
    """
    values = [value / SECONDS[unit] for value in times]
    return Row(work, unit, values, budget, units, limits, notes)


def as_markdown(rows: Sequence[Row], columns: Mapping[str, Callable[[Row], str]]) -> str:
    """Return a table in Markdown.

    Args:
        rows: of the table.
        columns: by heading, the function that returns the cell of a row.
    """
    lines = [f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    for row in rows:
        lines.append(f"| {' | '.join(cell(row) for cell in columns.values())} |")
    return "\n".join(lines)


def digits(value: float | None) -> str:
    """Return a number with three significant digits."""
    if value is None:
        return ""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


_NO_BUDGET = Budget("", None, None)
COLUMNS: dict[str, Callable[[Row], str]] = {
    "work": lambda row: row.work,
    "median": lambda row: f"{digits(statistics.median(row.values))} {row.unit}",
    "mean": lambda row: digits(statistics.fmean(row.values)),
    "least": lambda row: digits(min(row.values)),
    "units": lambda row: digits(row.multiple),
    "share of the limit": lambda row: f"{row.share_of_limit:.0%}" if row.limit_s else "",
    "reference": lambda row: (row.budget or _NO_BUDGET).reference,
    "must": lambda row: digits((row.budget or _NO_BUDGET).must),
    "aim": lambda row: digits((row.budget or _NO_BUDGET).aim),
    "notes": lambda row: row.notes,
}
"""Columns of the table; docs/performance.md describes them."""
