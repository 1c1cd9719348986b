"""Statistics of success over runs and test episodes.

Tests of a protocol play the same scenes in every run: runs and scenes are crossed, and the
difficulty of the scenes does not average out over runs. Intervals are percentiles of a
hierarchical bootstrap that resamples the runs of each task, then the scenes (Davison & Hinkley,
1997, section 3.8; Owen, 2007). Episodes of one scene are resampled together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from ba_torchrl.record.results import TestedPolicy

CONFIDENCE = 0.95
RESAMPLES = 2000
Z = 1.959963984540054
"""Quantile of the normal distribution for `CONFIDENCE`."""


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


def mean_success(
    tasks: Sequence[Sequence[TestedPolicy]], generator: np.random.Generator
) -> Estimate:
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
        ends = _interval(value, [(rates, by_run.mean(0)) for rates, by_run, _ in parts], generator)
        low, high = min(low, ends[0]), max(high, ends[1])
    return Estimate(float(value), float(max(low, 0.0)), float(min(high, 1.0)))


def mean_curve(rates: np.ndarray, episodes: np.ndarray, generator: np.random.Generator) -> Estimate:
    """Return the mean of evaluations during training with its interval, [points].

    As `mean_success`, but over runs alone: evaluations have no outcomes by episode.

    Args:
        rates: [runs, points].
        episodes: number behind each rate, [runs, points].
    """
    value = rates.mean(0)
    low, high = wilson(value, episodes.mean(0))[1:]
    if len(rates) > 1:
        ends = _interval(value, [(rates, np.zeros(1))], generator)
        low, high = np.minimum(low, ends[0]), np.maximum(high, ends[1])
    return Estimate(value, np.maximum(low, 0.0), np.minimum(high, 1.0))


def paired_difference(
    tasks: Sequence[tuple[Sequence[TestedPolicy], Sequence[TestedPolicy]]],
    generator: np.random.Generator,
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
    half = Z * np.sqrt(square) / len(parts)
    ends = _interval(value, parts, generator)
    low, high = min(value - half, ends[0]), max(value + half, ends[1])
    return Estimate(float(value), float(max(low, -1.0)), float(min(high, 1.0)))


def probability_of_improvement(
    tasks: Sequence[tuple[np.ndarray, np.ndarray]], generator: np.random.Generator
) -> Estimate:
    """Return the probability that a run of the first method has the higher success on its task.

    It is the mean over tasks of the share of pairs of runs, ties as one half (Agarwal et al.,
    2021), with the interval of a bootstrap over runs, stratified by task. The interval is never
    narrower than Wilson's of as many pairs as the method with fewer runs has runs, whose variance
    is the largest that the share can have (Birnbaum & Klose, 1957).

    Args:
        tasks: of each task the success rates of both methods' runs, [runs] each.
    """
    value, pairs, drawn = 0.0, 0, np.zeros(RESAMPLES)
    for first, second in tasks:
        wins = (np.sign(np.subtract.outer(first, second)) + 1) / 2
        rows, columns = (generator.integers(n, size=(RESAMPLES, n)) for n in wins.shape)
        value += wins.mean() / len(tasks)
        pairs += min(wins.shape)
        drawn += wins[rows[:, :, None], columns[:, None, :]].mean((1, 2)) / len(tasks)
    (low, high), floor = _quantiles(drawn), wilson(value, pairs)
    return Estimate(float(value), float(min(low, floor.low)), float(max(high, floor.high)))


def area_under_success(steps: Sequence[int], rates: Sequence[float], end: int) -> float:
    """Return the mean success rate over environment steps, from the first evaluation to ``end``.

    Rates between evaluations are interpolated linearly; the last one of a run that ended early
    stands for later ones. It is nan without steps between the first evaluation and ``end``.

    Args:
        steps: steps of all environments, demonstrations not counted, [n].
        rates: [n].
        end: last step of all runs that are compared.
    """
    if not len(steps) or end <= steps[0]:
        return float("nan")
    steps, rates = np.append(steps, end), np.append(rates, rates[-1])
    return float(np.diff(steps) @ (rates[1:] + rates[:-1]) / 2 / (end - steps[0]))


def _by_scene(tests: Sequence[TestedPolicy]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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


def _interval(
    value: np.ndarray | float,
    tasks: Sequence[tuple[np.ndarray, np.ndarray]],
    generator: np.random.Generator,
) -> np.ndarray:
    """Return the interval of a mean over tasks of means over runs, [2, ...].

    Resamples of n runs spread less than n runs do. Deviations over runs are widened by
    sqrt(n / (n - 1)) and by the ratio of the quantiles of Student's t and the normal distribution,
    with Satterthwaite's degrees of freedom over tasks.

    Args:
        value: the mean, [...].
        tasks: of each task the values of its runs, [runs, ...], and the influences of its scenes
            on their mean, [scenes].
    """
    drawn = np.zeros((RESAMPLES, *np.shape(value)))
    several = [runs for runs, _ in tasks if len(runs) > 1]
    for _, influence in tasks:
        scenes = generator.integers(len(influence), size=(RESAMPLES, len(influence)))
        of_scenes = influence[scenes].sum(1)
        drawn += of_scenes.reshape(-1, *np.ones(np.ndim(value), int))
    if several:
        squares = [runs.var(0, ddof=1) / len(runs) for runs in several]
        rest = sum(
            square**2 / (len(runs) - 1) for square, runs in zip(squares, several, strict=True)
        )
        most = sum(len(runs) - 1 for runs in several)
        with np.errstate(invalid="ignore"):
            freedom = np.where(rest > 0, sum(squares) ** 2 / rest, most)
        widening = stdtrit(freedom, (1 + CONFIDENCE) / 2) / Z
        for runs in several:
            n = len(runs)
            means = runs[generator.integers(n, size=(RESAMPLES, n))].mean(1)
            drawn += widening * np.sqrt(n / (n - 1)) * (means - runs.mean(0))
    return value + _quantiles(drawn / len(tasks))


def _quantiles(drawn: np.ndarray) -> np.ndarray:
    return np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], axis=0)
