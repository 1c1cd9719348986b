"""Comparison of rows with those of an earlier run."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import bootstrap

from ba_torchrl.profiling.table import SECONDS, Row, digits

CONFIDENCE = 0.95
RESAMPLES = 2000
LEAST_VALUES = 6
"""Smallest sample whose range contains the median with that confidence (1 - 2 / 2^6 = 0.97)."""
BLOCKS = 20
"""Least number of blocks of consecutive values, which are resampled together."""
_BATCH = 200


@dataclass(frozen=True)
class Ratio:
    """A ratio of medians and its bootstrap percentile interval; no interval for few values."""

    value: float
    interval: tuple[float, float] | None

    @property
    def is_above_noise(self) -> bool | None:
        """Whether the interval excludes 1; None without an interval."""
        if self.interval is None:
            return None
        low, high = self.interval
        return not low <= 1 <= high

    def __str__(self) -> str:
        if self.interval is None:
            return f"{self.value:.3g}"
        low, high = self.interval
        return f"{self.value:.3g} ({low:.3g} to {high:.3g})"


def ratio_of_medians(
    numerators: Sequence[Sequence[float]], denominators: Sequence[Sequence[float]]
) -> Ratio:
    """Return a ratio of products of medians.

    The samples are resampled independently of each other, long ones in at least `BLOCKS` blocks,
    since consecutive durations depend on each other (E. Carlstein, The Use of Subseries
    Values for Estimating the Variance of a General Statistic, 1986).

    Args:
        numerators: samples whose medians are multiplied, in the order of measurement.
        denominators: samples by whose medians the product is divided.
    """
    count = len(numerators)
    samples = [np.asarray(sample) for sample in (*numerators, *denominators)]
    value = _ratio([np.median(sample) for sample in samples], count)
    if min(map(len, samples)) < LEAST_VALUES:
        return Ratio(float(value), None)
    blocks = [_blocks(sample) for sample in samples]

    def statistic(*chosen: np.ndarray, axis: int) -> np.ndarray:
        resampled = (
            each[i].reshape(*i.shape[:-1], -1) for each, i in zip(blocks, chosen, strict=True)
        )
        return _ratio([np.median(sample, axis=axis) for sample in resampled], count)

    interval = bootstrap(
        [np.arange(len(each)) for each in blocks],
        statistic,
        n_resamples=RESAMPLES,
        batch=_BATCH,
        vectorized=True,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Ratio(float(value), (float(interval.low), float(interval.high)))


def _ratio(medians: Sequence[np.ndarray], count: int) -> np.ndarray:
    return np.prod(medians[:count], axis=0) / np.prod(medians[count:], axis=0)


def _blocks(sample: np.ndarray) -> np.ndarray:
    """Return consecutive values [blocks, length], without the first ones that fill no block."""
    length = max(len(sample) // BLOCKS, 1)
    return sample[len(sample) % length :].reshape(-1, length)


@dataclass(frozen=True)
class Change:
    """An earlier row beside a new one."""

    old: Row
    of_values: Ratio
    """New median over the old one."""
    of_units: Ratio | None
    """The same as multiples of the unit of work; None if a row has no unit."""

    @classmethod
    def between(cls, old: Row, new: Row) -> Change:
        """Compare two rows with the same unit."""
        units = None
        if old.unit_s and new.unit_s:
            if new.unit in SECONDS:  # duration / unit of work
                units = ratio_of_medians([new.values, old.unit_s], [old.values, new.unit_s])
            else:  # frames per second x unit of work
                units = ratio_of_medians([new.values, new.unit_s], [old.values, old.unit_s])
        return cls(old, ratio_of_medians([new.values], [old.values]), units)

    @property
    def difference(self) -> str:
        """Whether the difference is above the noise, in units of work where there are units."""
        is_above = (self.of_units or self.of_values).is_above_noise
        return {None: "", True: "above noise", False: "within noise"}[is_above]


def columns_of_changes(
    old_rows: Sequence[Row], new_rows: Sequence[Row]
) -> dict[str, Callable[[Row], str]]:
    """Return the columns of a table that compare its rows with those of the same work and unit.

    Args:
        old_rows: of an earlier run.
        new_rows: of the table; cells are empty where there is no old row.
    """
    old = {(row.work, row.unit): row for row in old_rows}
    changes = {
        (row.work, row.unit): Change.between(old[row.work, row.unit], row)
        for row in new_rows
        if (row.work, row.unit) in old
    }

    def cell(text: Callable[[Change], str]) -> Callable[[Row], str]:
        def of_row(row: Row) -> str:
            change = changes.get((row.work, row.unit))
            return "" if change is None else text(change)

        return of_row

    return {
        "old median": cell(lambda change: digits(statistics.median(change.old.values))),
        "new / old": cell(lambda change: str(change.of_values)),
        "new / old, units": cell(lambda change: str(change.of_units or "")),
        "difference": cell(lambda change: change.difference),
    }
