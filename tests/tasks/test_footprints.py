"""Footprints on the plane: rectangles, gaps, the narrowest grasp."""

import math

import numpy as np
import pytest

from ba_torchrl.tasks.manipulation.footprints import Rectangle, gap_m, gaps_m, narrowest
from ba_torchrl.tasks.workspace import Workspace
from tests.tasks.packing.scenes import BIN


@pytest.mark.parametrize(
    ("second", "gap"),
    [
        (Rectangle(0.5, 0.0, 0.0, 0.1, 0.1), 0.2),
        (Rectangle(0.0, -0.4, 0.0, 0.1, 0.1), 0.2),
        (Rectangle(0.35, 0.0, math.pi / 2, 0.05, 0.1), 0.05),
        (Rectangle(0.25, 0.0, 0.0, 0.1, 0.1), -0.05),
        (Rectangle(0.0, 0.0, 0.3, 0.01, 0.01), None),
        (Rectangle(0.32, 0.0, 0.0, 0.1, 0.1), 0.02),
        (Rectangle(0.32, 0.0, math.pi / 4, 0.1, 0.1), None),  # half its diagonal is 0.141
    ],
)
def test_gaps_between_rectangles(second, gap):
    first = Rectangle(0.0, 0.0, 0.0, 0.2, 0.1)
    for yaw in (0.0, 0.7):  # a common rotation changes nothing
        a = first._replace(yaw_rad=yaw)
        x, y = a.frame.to_world(second.x, second.y)
        b = second._replace(x=x, y=y, yaw_rad=second.yaw_rad + yaw)
        assert gap_m(a, b) == pytest.approx(gap_m(b, a))
        if gap is None:
            assert gap_m(a, b) < 0
        else:
            assert gap_m(a, b) == pytest.approx(gap)


def test_gaps_between_all_rectangles_of_two_lists_are_those_of_each_pair():
    rng = np.random.default_rng(0)
    rectangles = [
        Rectangle(*rng.uniform((-0.2, -0.2, -4.0, 0.01, 0.01), (0.2, 0.2, 4.0, 0.1, 0.1)))
        for _ in range(12)
    ]
    first, second = rectangles[:5], rectangles[5:]
    expected = [[gap_m(a, b) for b in second] for a in first]
    assert np.min(expected) < 0 < np.max(expected)
    assert gaps_m(first, second) == pytest.approx(np.array(expected), abs=1e-12)
    assert gaps_m(first, []).shape == (5, 0)


def test_a_rectangle_converts_and_contains_points():
    rectangle = Rectangle(0.4, -0.1, 0.6, 0.2, 0.1)
    assert rectangle.frame.to_local(*rectangle.frame.to_world(0.03, -0.07)) == pytest.approx(
        (0.03, -0.07)
    )
    inside = np.array([[*rectangle.frame.to_world(0.19, 0.09), 5.0]])
    outside = np.array([[*rectangle.frame.to_world(0.19, 0.11), 5.0]])
    assert rectangle.contains(inside)
    assert not rectangle.contains(np.concatenate([inside, outside]))
    workspace = Workspace((0.0, 1.0), (-0.5, 0.5), (0.0, 1.0))
    assert rectangle.is_inside(workspace)
    assert not rectangle._replace(x=0.2).is_inside(workspace)  # a corner is outside


def test_the_narrowest_footprint_is_found_in_any_pose(make_env):
    env = make_env(BIN)
    env.reset()
    body = next(b for b in env.scene.task.pool.bodies if b.name.startswith("plank"))
    for yaw in (0.0, 0.9, 2.5):
        body.place((0.4, 0.0, 0.01), yaw)
        (found,) = narrowest(body)
        assert found.half_x == pytest.approx(0.02)
        assert found.half_y == pytest.approx(0.04)
        assert math.cos(2 * (found.yaw_rad - yaw)) == pytest.approx(1.0)
    cube = next(b for b in env.scene.task.pool.bodies if b.name.startswith("cube"))
    cube.place((0.4, 0.0, 0.02), 0.3)
    assert len(narrowest(cube)) == 2
