"""Comparison of rows with those of an earlier run."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import bootstrap

from profiling.table import SECONDS, Row, digits

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


def changes(old: Row, new: Row) -> tuple[Ratio, Ratio | None]:
    """Return the new median over the old one, and the same as multiples of the unit of work.

    The latter is None if a row has no unit of work.
    """
    of_values = ratio_of_medians([new.values], [old.values])
    if not (old.unit_s and new.unit_s):
        return of_values, None
    if new.unit in SECONDS:  # duration / unit of work
        return of_values, ratio_of_medians([new.values, old.unit_s], [old.values, new.unit_s])
    # frames per second x unit of work
    return of_values, ratio_of_medians([new.values, new.unit_s], [old.values, old.unit_s])


def columns_of_changes(
    old_rows: Sequence[Row], new_rows: Sequence[Row]
) -> dict[str, Callable[[Row], str]]:
    """Return the columns of a table that compare its rows with those of the same work and unit.

    Args:
        old_rows: of an earlier run.
        new_rows: of the table; cells are empty where there is no old row.
    """
    old = {(row.work, row.unit): row for row in old_rows}
    cells: dict[tuple[str, str], tuple[str, ...]] = {}
    for row in new_rows:
        key = (row.work, row.unit)
        if key in old:
            of_values, of_units = changes(old[key], row)
            is_above = (of_units or of_values).is_above_noise
            cells[key] = (
                digits(statistics.median(old[key].values)),
                str(of_values),
                str(of_units or ""),
                {None: "", True: "above noise", False: "within noise"}[is_above],
            )
    headings = ("old median", "new / old", "new / old, units", "difference")
    nothing = ("",) * len(headings)
    return {
        heading: lambda row, i=i: cells.get((row.work, row.unit), nothing)[i]
        for i, heading in enumerate(headings)
    }
