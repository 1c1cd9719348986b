"""Statistics of success over runs and test episodes.

Tests of a protocol play the same scenes in every run: runs and scenes are crossed, and the
difficulty of the scenes does not average out over runs. Intervals are normal, with the variance of
runs and that of scenes (Owen, 2007), the former with the quantile of Student's t. Episodes of one
scene are one cluster.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.integrate import trapezoid
from scipy.stats import norm, sem, t

from ba_torchrl.record.results import PolicyTest

CONFIDENCE = 0.95
UPPER = (1 + CONFIDENCE) / 2
Z = float(norm.ppf(UPPER))


class Estimate(NamedTuple):
    """A value and its interval at `CONFIDENCE`: numbers, or arrays of one shape."""

    value: float | np.ndarray
    low: float | np.ndarray
    high: float | np.ndarray


def wilson(rate: float | np.ndarray, episodes: float | np.ndarray) -> Estimate:
    """Return success rates with Wilson's interval."""
    rate, episodes = np.asarray(rate, float), np.asarray(episodes, float)
    half = Z * np.sqrt(rate * (1 - rate) / episodes + (Z / (2 * episodes)) ** 2)
    centre, scale = rate + Z**2 / (2 * episodes), 1 + Z**2 / episodes
    low = np.where(rate <= 0, 0.0, (centre - half) / scale)
    return Estimate(rate, low, np.where(rate >= 1, 1.0, (centre + half) / scale))


def mean_success(tasks: Sequence[Sequence[PolicyTest]]) -> Estimate:
    """Return the mean success over runs, and over tasks with equal weights, with its interval.

    The interval is never narrower than Wilson's for one run at the mean rate: all runs are tested
    on the same scenes, and more runs are no replacement for more scenes. Over tasks these
    intervals are combined as by Zou & Donner (2008). Where every task has a single run, this is
    the interval, which does not contain the spread over runs. Episodes that share a scene reduce
    the number of episodes by their design effect.

    Args:
        tasks: the tests of the runs of each task.
    """
    parts = [_by_scene(tests) for tests in tasks]
    means = np.array([rates.mean() for rates, *_ in parts])
    floor = wilson(means, [_effective_episodes(*part) for part in parts])
    value = means.mean()
    low = value - np.linalg.norm(means - floor.low) / means.size
    high = value + np.linalg.norm(floor.high - means) / means.size
    if any(rates.size > 1 for rates, *_ in parts):
        half = _half_width([(rates, by_run.mean(0)) for rates, by_run, _ in parts])
        low, high = min(low, value - half), max(high, value + half)
    return Estimate(float(value), float(max(low, 0.0)), float(min(high, 1.0)))


def mean_curve(rates: np.ndarray, episodes: np.ndarray) -> Estimate:
    """Return the mean of evaluations during training with its interval, [points].

    As `mean_success`, but over runs alone: evaluations have no outcomes by episode.

    Args:
        rates: [runs, points].
        episodes: number behind each rate, [runs, points].
    """
    value = rates.mean(0)
    low, high = wilson(value, episodes.mean(0))[1:]
    if len(rates) > 1:
        half = _half_width([(rates, np.zeros(1))])
        low, high = np.minimum(low, value - half), np.maximum(high, value + half)
    return Estimate(value, np.maximum(low, 0.0), np.minimum(high, 1.0))


def paired_difference(
    tasks: Sequence[tuple[Sequence[PolicyTest], Sequence[PolicyTest]]],
) -> Estimate:
    """Return the mean difference of success, first minus second, with its interval.

    Runs are paired by seed, their episodes by test scene. The interval is never narrower than the
    normal one over the scenes of one run in which two more scenes, of weight one half, differ:
    one in favour of each method (Agresti & Min, 2005).

    Args:
        tasks: of each task the tests of the first method's runs, and those of the second method's
            runs of the same seeds, in the same order.
    """
    parts, square = [], 0.0
    for first, second in tasks:
        rates, by_run, episodes = _by_scene([*first, *second])
        middle = len(first)
        influence = (by_run[:middle] - by_run[middle:]).mean(0)
        parts.append((rates[:middle] - rates[middle:], influence))
        square += (influence**2).sum() + (episodes > 0).sum(1).mean() ** -2.0
    value = np.mean([difference.mean() for difference, _ in parts])
    half = max(Z * np.sqrt(square) / len(parts), _half_width(parts))
    return Estimate(float(value), float(max(value - half, -1)), float(min(value + half, 1)))


def mean_difference(differences: Sequence[float]) -> Estimate:
    """Return the mean of differences between pairs of runs with its interval of Student's t.

    The interval is nan for fewer than two pairs.

    Args:
        differences: of a measure with values from 0 to 1, first minus second, of each pair.
    """
    value = float(np.mean(differences)) if len(differences) else math.nan
    if len(differences) < 2:
        return Estimate(value, math.nan, math.nan)
    half = t.ppf(UPPER, len(differences) - 1) * sem(differences)
    return Estimate(value, float(max(value - half, -1)), float(min(value + half, 1)))


def area_under_success(steps: Sequence[int], rates: Sequence[float], end: int) -> float:
    """Return the mean success rate over steps, from the first evaluation to ``end``.

    Rates between evaluations are interpolated linearly; the last one of a run that ended early
    stands for later ones. It is nan without steps between the first evaluation and ``end``.

    Args:
        steps: of all environments, demonstrations not counted, or updates, [n].
        rates: [n].
        end: last step of all runs that are compared.
    """
    if not len(steps) or end <= steps[0]:
        return float("nan")
    area = trapezoid([*rates, rates[-1]], [*steps, end])
    return float(area / (end - steps[0]))


def _by_scene(tests: Sequence[PolicyTest]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return success rates, influences of scenes and episodes of scenes.

    An influence is the change of a run's rate by one more occurrence of a scene; those of a run
    have the sum 0.

    Returns:
        [runs], [runs, scenes] and [runs, scenes].
    """
    sizes = [len(test.seeds) for test in tests]
    scenes, column = np.unique(np.concatenate([test.seeds for test in tests]), return_inverse=True)
    place = np.repeat(np.arange(len(tests)), sizes), column
    successes, episodes = np.zeros((2, len(tests), scenes.size))
    np.add.at(successes, place, np.concatenate([test.successes for test in tests]))
    np.add.at(episodes, place, 1)
    played = episodes.sum(1, keepdims=True)
    rates = successes.sum(1, keepdims=True) / played
    return rates[:, 0], (successes - rates * episodes) / played, episodes


def _effective_episodes(rates: np.ndarray, by_run: np.ndarray, episodes: np.ndarray) -> float:
    """Return the number of independent episodes with the variance of the scenes of one run.

    It is at least the number of scenes, and at most that of episodes.
    """
    variance, scenes = (by_run**2).sum(1).mean(), (episodes > 0).sum(1).mean()
    number = (rates * (1 - rates)).mean() / variance if variance else scenes
    return float(np.clip(number, scenes, episodes.sum(1).mean()))


def _half_width(tasks: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return half of the interval of a mean over tasks of means over runs, [...].

    The variance of the runs has Satterthwaite's degrees of freedom over tasks.

    Args:
        tasks: of each task the values of its runs, [runs, ...], and the influences of its scenes
            on their mean, [scenes].
    """
    of_scenes = Z**2 * sum((influence**2).sum() for _, influence in tasks)
    several = [runs for runs, _ in tasks if len(runs) > 1]
    of_runs = [runs.var(0, ddof=1) / len(runs) for runs in several]
    shares = [square**2 / (len(runs) - 1) for square, runs in zip(of_runs, several, strict=True)]
    with np.errstate(invalid="ignore"):
        freedom = np.divide(np.square(sum(of_runs)), sum(shares))
    quantile = np.nan_to_num(t.ppf(UPPER, freedom))  # runs without a difference: 0
    return np.sqrt(of_scenes + quantile**2 * sum(of_runs)) / len(tasks)
