"""Regions of the ground: axis-aligned and oriented rectangles."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ba_torchrl.core.errors import PlacementError
from ba_torchrl.sim.geometry import PlanarFrame
from ba_torchrl.tasks.terrain.sloped import OrientedArea
from ba_torchrl.tasks.workspace import Area

AREA = Area((0.2, 0.6), (-0.1, 0.3))


def oriented(half_x=0.3, half_y=0.03, heading=0.5):
    return OrientedArea(*AREA.bounds, PlanarFrame(0.4, 0.1, heading), half_x, half_y)


def test_points_outside_of_an_area_have_a_distance():
    points = np.array([(0.4, 0.0), (0.2, 0.3), (0.65, 0.0), (0.1, 0.5)])
    assert AREA.outside_m(points) == pytest.approx([0.0, 0.0, 0.05, 0.2])
    assert AREA.shrunk(0.05).outside_m(points[:2]) == pytest.approx([0.0, 0.05])


@pytest.mark.parametrize("heading", [0.0, 0.5, math.pi / 2, 2.8])
def test_random_points_and_sites_are_inside(heading):
    area, rng = oriented(heading=heading), np.random.default_rng(0)
    points = np.array([area.random_point(rng, 0.02) for _ in range(200)])
    along, across = area.frame.to_local(*points.T)
    assert abs(across).max() <= 0.02 + 1e-9
    assert np.ptp(across) > 0.035
    assert np.ptp(along) > 0.3
    for found in (points, area.sites()):
        assert area.outside_m(found) == pytest.approx(0.0, abs=1e-12)


def test_an_area_narrower_than_the_border_is_the_line_along_its_centre():
    area = oriented()
    assert area.heading_rad is None
    line = area.shrunk(0.04)
    assert line.heading_rad == 0.5
    _, across = line.frame.to_local(*line.sites().T)
    assert abs(across).max() < 1e-12
    side = np.array([area.frame.to_world(0.0, 0.05)])
    assert line.outside_m(side) == pytest.approx(0.05)


def test_an_oriented_area_outside_of_its_limits_has_no_points():
    area = replace(oriented(), frame=PlanarFrame(2.0, 2.0, 0.0), half_x=0.1)
    with pytest.raises(PlacementError, match="enlarge"):
        area.random_point(np.random.default_rng(0))
