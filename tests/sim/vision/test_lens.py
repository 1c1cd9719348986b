"""Perspective cameras: heights, depth ranges, field of view."""

import math

import numpy as np
import pytest

from ba_torchrl.sim.vision.depth import SceneMesh, depth_image
from ba_torchrl.sim.vision.lens import FAR_M, Lens, oblique_lens, side_lenses
from tests.sim.vision.boxes import CENTER, placed, ray_depths


def test_a_lens_returns_heights_and_the_depth_range_of_planes():
    lens = oblique_lens(CENTER)
    box = placed((0.2, 0.2, 0.06), (0.45, 0.0, 0.03))
    depth = depth_image([SceneMesh([box])], lens, 100)
    heights = lens.heights_m(depth)
    assert heights[50, 50] == pytest.approx(0.06, abs=1e-9)
    np.testing.assert_allclose(heights[:5], 0.0, atol=1e-9)
    floor = ray_depths([], lens, 1000)
    low, high = lens.plane_depth_range_m(0.0)
    assert low == pytest.approx(floor.min(), rel=2e-3)
    assert high == pytest.approx(floor.max(), rel=2e-3)
    upward = Lens((0.0, 0.0, 0.3), (1.0, 0.0, 0.3), 1.0)
    assert upward.plane_depth_range_m(0.0)[1] == FAR_M


@pytest.mark.parametrize("width", [0.3, 0.45, 0.75, 1.2])
def test_side_cameras_see_the_whole_square(width):
    for lens in side_lenses(CENTER, width):
        for dx in (-width / 2, width / 2):
            for dy in (-width / 2, width / 2):
                offset = np.array([CENTER[0] + dx, CENTER[1] + dy, 0.0]) - lens.eye_m
                rows, columns, depth = lens.axes @ offset
                assert max(abs(rows), abs(columns)) / depth < math.tan(lens.fov_rad / 2)
