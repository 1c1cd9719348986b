"""Statistics against known answers: simulated runs, direct counts, areas by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binomtest, norm

from ba_torchrl.record import statistics
from ba_torchrl.record.statistics import (
    area_under_success,
    mean_curve,
    mean_success,
    paired_difference,
    probability_of_improvement,
    wilson,
)

SCENES = 100


def runs(outcomes, seeds=None):
    """Return tests with successes [runs, episodes]."""
    seeds = np.arange(np.shape(outcomes)[1]) if seeds is None else seeds
    return [SimpleNamespace(seeds=seeds, successes=each) for each in np.asarray(outcomes)]


def generator(seed=0):
    return np.random.default_rng(seed)


def beta_runs(random, n):
    """Return runs whose rates have a beta distribution, tested on scenes of their own; the mean."""
    return random.binomial(1, random.beta(8, 2, (n, 1)), (n, SCENES)), 0.8


def crossed_runs(random, n, mean=1.0, scenes=None):
    """Return runs on the same scenes, whose difficulty dominates; the mean."""
    scenes = random.normal(size=SCENES) if scenes is None else scenes
    score = mean + 0.3 * random.normal(size=(n, 1)) + 2 * scenes + random.normal(size=(n, SCENES))
    return (score > 0).astype(int), norm.cdf(mean / np.sqrt(1 + 4 + 0.3**2))


def clustered_run(random, n):
    """Return runs with five episodes in each of forty scenes, and the mean."""
    rates = np.repeat(random.beta(4, 2, (n, 40)), 5, axis=1)
    return random.binomial(1, rates), 2 / 3


def share_inside(simulate, times=200):
    """Return how many of several intervals hold the true value, as a fraction."""
    random = generator(7)
    inside = [
        low <= truth <= high for truth, (_, low, high) in (simulate(random) for _ in range(times))
    ]
    return np.mean(inside)


@pytest.fixture
def fewer_resamples(monkeypatch):
    monkeypatch.setattr(statistics, "RESAMPLES", 500)


@pytest.mark.parametrize("draw", [beta_runs, crossed_runs])
@pytest.mark.parametrize("n", [3, 5, 10])
@pytest.mark.usefixtures("fewer_resamples")
def test_intervals_hold_the_mean_of_simulated_runs(draw, n):
    def simulate(random):
        outcomes, truth = draw(random, n)
        return truth, mean_success([runs(outcomes)], random)

    assert 0.92 <= share_inside(simulate) <= 0.99


@pytest.mark.parametrize("n", [1, 5])
@pytest.mark.usefixtures("fewer_resamples")
def test_episodes_of_one_scene_are_not_independent(n):
    seeds = np.repeat(np.arange(40), 5)

    def simulate(random):
        outcomes, truth = clustered_run(random, n)
        return truth, mean_success([runs(outcomes, seeds)], random)

    assert share_inside(simulate) >= 0.91


@pytest.mark.usefixtures("fewer_resamples")
def test_the_interval_over_tasks_holds_their_mean():
    def simulate(random):
        tasks = [runs(beta_runs(random, n)[0]) for n in (2, 3, 5)]
        return 0.8, mean_success(tasks, random)

    assert 0.92 <= share_inside(simulate) <= 0.99


@pytest.mark.usefixtures("fewer_resamples")
def test_the_interval_of_a_paired_difference_holds_it():
    def simulate(random):
        scenes = random.normal(size=SCENES)
        (first, high), (second, low) = (crossed_runs(random, 5, mean, scenes) for mean in (1, 0.5))
        return high - low, paired_difference([(runs(first), runs(second))], random)

    assert 0.92 <= share_inside(simulate) <= 0.99


def test_pairs_of_scenes_narrow_the_interval_of_a_difference():
    random = generator(1)
    first = random.binomial(1, 0.5, SCENES)
    second = np.where(np.arange(SCENES) < 5, 1 - first, first)

    def width(order):
        _, low, high = paired_difference([(runs([first]), runs([second[order]]))], generator())
        return high - low

    assert 2 * width(np.arange(SCENES)) < width(random.permutation(SCENES))
    value, low, high = paired_difference([(runs([first]), runs([first]))], generator())
    assert (value, low, high) == pytest.approx((0, -1.96 / SCENES, 1.96 / SCENES), abs=1e-4)


def wilson_interval(successes, episodes):
    """SciPy's."""
    found = binomtest(successes, episodes).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def test_a_single_run_has_the_interval_of_wilson():
    outcomes = np.arange(50) < 45
    assert wilson(0.9, 50)[1:] == pytest.approx(wilson_interval(45, 50))
    assert [float(end) for end in wilson(1.0, 50)[1:]] == pytest.approx(wilson_interval(50, 50))
    assert mean_success([runs([outcomes])], generator())[1:] == pytest.approx(
        wilson_interval(45, 50)
    )
    # five episodes in each of ten scenes, that all have the same outcome: ten episodes
    found = mean_success([runs([outcomes], np.arange(50) // 5)], generator())
    assert found[1:] == pytest.approx(wilson_interval(9, 10))


def test_no_interval_is_narrower_than_that_of_one_run():
    outcomes = np.tile(np.arange(50) < 45, (8, 1))
    value, low, high = mean_success([runs(outcomes)], generator())
    below, above = wilson_interval(45, 50)
    assert low <= below + 1e-9 < value < above - 1e-9 <= high
    curve = mean_curve(np.full((8, 2), 0.9), np.full((8, 2), 50), generator())
    assert curve.low == pytest.approx([below] * 2)
    assert curve.high == pytest.approx([above] * 2)


def test_runs_that_differ_have_a_wider_interval_of_their_curve():
    rates = np.array([[0.1, 0.9], [0.9, 0.9], [0.5, 0.9]])
    curve = mean_curve(rates, np.full((3, 2), 1000), generator())
    assert curve.value == pytest.approx([0.5, 0.9])
    # t of two degrees of freedom: 4.30 standard errors
    assert (curve.low[0], curve.high[0]) == (0, 1)
    assert curve.high[1] - curve.low[1] == pytest.approx(np.diff(wilson_interval(900, 1000))[0])


def test_the_generator_decides_the_interval():
    tests = runs(beta_runs(generator(), 5)[0])
    first, same, other = (mean_success([tests], generator(seed)) for seed in (1, 1, 2))
    assert first == same != other


def test_the_probability_of_improvement_is_the_share_of_pairs():
    random = generator(3)
    first, second = random.integers(0, 6, 7) / 5, random.integers(0, 6, 4) / 5
    count = sum((a > b) + (a == b) / 2 for a in first for b in second) / 28
    value, low, high = probability_of_improvement([(first, second)], generator())
    assert value == pytest.approx(count)
    assert 0 <= low < value < high <= 1
    over_tasks = probability_of_improvement([(first, second), (second, first)], generator())
    assert over_tasks.value == pytest.approx(0.5)
    found = probability_of_improvement([([0.9] * 5, [0.8, 0.1] * 3)], generator())
    assert found == pytest.approx((1, *wilson_interval(5, 5)))


@pytest.mark.parametrize(
    ("steps", "rates", "end", "area"),
    [
        ([0, 100], [0.0, 1.0], 100, 0.5),
        ([0, 50, 100], [0.4, 0.4, 0.4], 100, 0.4),
        ([0, 20, 100], [0.0, 1.0, 1.0], 100, 0.9),  # not the mean of the points
        ([100, 200], [0.0, 1.0], 200, 0.5),  # of the range that was evaluated
        ([0, 50], [0.0, 1.0], 100, 0.75),  # ended early
        ([0, 0], [0.0, 1.0], 0, None),  # demonstrations only
        ([0, 0], [0.0, 1.0], 100, 1.0),
        ([], [], 100, None),
    ],
)
def test_areas_under_success(steps, rates, end, area):
    found = area_under_success(steps, rates, end)
    assert np.isnan(found) if area is None else found == pytest.approx(area)
