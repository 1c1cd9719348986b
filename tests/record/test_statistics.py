"""Statistics against known answers: simulated runs, SciPy's intervals, areas by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binomtest, norm, ttest_1samp

from ba_torchrl.record.statistics import (
    area_under_success,
    mean_curve,
    mean_difference,
    mean_success,
    paired_difference,
    wilson,
)

SCENES = 100


def runs(outcomes, seeds=None):
    """Return tests with successes [runs, episodes]."""
    seeds = np.arange(np.shape(outcomes)[1]) if seeds is None else seeds
    return [SimpleNamespace(seeds=seeds, successes=each) for each in np.asarray(outcomes)]


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
    random = np.random.default_rng(7)
    inside = [
        low <= truth <= high for truth, (_, low, high) in (simulate(random) for _ in range(times))
    ]
    return np.mean(inside)


@pytest.mark.parametrize("draw", [beta_runs, crossed_runs])
@pytest.mark.parametrize("n", [3, 5, 10])
def test_intervals_hold_the_mean_of_simulated_runs(draw, n):
    def simulate(random):
        outcomes, truth = draw(random, n)
        return truth, mean_success([runs(outcomes)])

    assert 0.92 <= share_inside(simulate) <= 0.99


@pytest.mark.parametrize("n", [1, 5])
def test_episodes_of_one_scene_are_not_independent(n):
    seeds = np.repeat(np.arange(40), 5)

    def simulate(random):
        outcomes, truth = clustered_run(random, n)
        return truth, mean_success([runs(outcomes, seeds)])

    assert share_inside(simulate) >= 0.91


def test_the_interval_over_tasks_holds_their_mean():
    def simulate(random):
        tasks = [runs(beta_runs(random, n)[0]) for n in (2, 3, 5)]
        return 0.8, mean_success(tasks)

    assert 0.92 <= share_inside(simulate) <= 0.99


def test_the_interval_of_a_paired_difference_holds_it():
    def simulate(random):
        scenes = random.normal(size=SCENES)
        (first, high), (second, low) = (crossed_runs(random, 5, mean, scenes) for mean in (1, 0.5))
        return high - low, paired_difference([(runs(first), runs(second))])

    assert 0.92 <= share_inside(simulate) <= 0.99


def test_the_interval_of_differences_of_runs_is_that_of_a_t_test():
    values = [0.1, 0.4, -0.2, 0.3, 0.25]
    low, high = ttest_1samp(values, 0).confidence_interval(0.95)
    assert mean_difference(values) == pytest.approx((np.mean(values), low, high))
    assert mean_difference([1.0, -0.6])[1:] == (-1, 1)
    assert np.isnan(mean_difference([0.5])).tolist() == [False, True, True]


def test_pairs_of_scenes_narrow_the_interval_of_a_difference():
    random = np.random.default_rng(1)
    first = random.binomial(1, 0.5, SCENES)
    second = np.where(np.arange(SCENES) < 5, 1 - first, first)

    def width(order):
        _, low, high = paired_difference([(runs([first]), runs([second[order]]))])
        return high - low

    assert 2 * width(np.arange(SCENES)) < width(random.permutation(SCENES))
    value, low, high = paired_difference([(runs([first]), runs([first]))])
    assert (value, low, high) == pytest.approx((0, -1.96 / SCENES, 1.96 / SCENES), abs=1e-4)


def wilson_interval(successes, episodes):
    """SciPy's."""
    found = binomtest(successes, episodes).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def test_a_single_run_has_the_interval_of_wilson():
    outcomes = np.arange(50) < 45
    assert wilson(0.9, 50)[1:] == pytest.approx(wilson_interval(45, 50))
    assert [float(end) for end in wilson(1.0, 50)[1:]] == pytest.approx(wilson_interval(50, 50))
    assert mean_success([runs([outcomes])])[1:] == pytest.approx(wilson_interval(45, 50))
    # five episodes in each of ten scenes, that all have the same outcome: ten episodes
    found = mean_success([runs([outcomes], np.arange(50) // 5)])
    assert found[1:] == pytest.approx(wilson_interval(9, 10))


def test_scenes_are_never_fewer_episodes_than_their_number():
    """The design effect would leave 2.67 episodes of three scenes, one of which is played twice."""
    _, low, high = mean_success([runs([[1, 1, 0, 0]], seeds=[1, 1, 2, 3])])
    expected = wilson(0.5, 3)
    assert (low, high) == pytest.approx((expected.low.item(), expected.high.item()))


def test_no_interval_is_narrower_than_that_of_one_run():
    outcomes = np.tile(np.arange(50) < 45, (8, 1))
    value, low, high = mean_success([runs(outcomes)])
    below, above = wilson_interval(45, 50)
    assert low <= below + 1e-9 < value < above - 1e-9 <= high
    curve = mean_curve(np.full((8, 2), 0.9), np.full((8, 2), 50))
    assert curve.low == pytest.approx([below] * 2)
    assert curve.high == pytest.approx([above] * 2)


def test_runs_that_differ_have_a_wider_interval_of_their_curve():
    rates = np.array([[0.1, 0.9], [0.9, 0.9], [0.5, 0.9]])
    curve = mean_curve(rates, np.full((3, 2), 1000))
    assert curve.value == pytest.approx([0.5, 0.9])
    # t of two degrees of freedom: 4.30 standard errors
    assert (curve.low[0], curve.high[0]) == (0, 1)
    assert curve.high[1] - curve.low[1] == pytest.approx(np.diff(wilson_interval(900, 1000))[0])


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
