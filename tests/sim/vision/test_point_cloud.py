"""Point clouds from depth images, and heightmaps from point clouds."""

import math

import numpy as np
import pytest

from ba_torchrl.sim.geometry import rotation_array
from ba_torchrl.sim.shapes import Decal
from ba_torchrl.sim.vision.depth import (
    PosedShape,
    SceneMesh,
    point_cloud,
    splat_heightmap,
    visible_points,
)
from ba_torchrl.sim.vision.lens import side_lenses
from tests.sim.vision.boxes import CENTER, random_boxes

WORKSPACE = ((0.3, 0.6), (-0.15, 0.15), (0.01, 0.25))


def distance_to_box(points, box):
    position, turn = box.pose
    inside = (
        np.abs((points - np.array(position)) @ rotation_array(turn))
        - np.array(box.shape.size_m) / 2
    )
    outer = np.linalg.norm(np.maximum(inside, 0), axis=1)
    return np.abs(outer + np.minimum(inside.max(axis=1), 0))


def test_points_lie_on_the_surfaces_inside_the_bounds():
    boxes = random_boxes(np.random.default_rng(2), 4, span=0.1)
    lenses = side_lenses(CENTER, 0.3)
    cloud = point_cloud([SceneMesh(boxes)], lenses, 3000, WORKSPACE)
    assert cloud.shape == (3000, 3)
    assert cloud.dtype == np.float32
    distances = np.stack([distance_to_box(cloud, box) for box in boxes] + [np.abs(cloud[:, 2])])
    assert distances.min(axis=0).max() < 1e-6
    assert ((distances < 1e-6).sum(axis=1) > 20).all()  # every box, and the floor
    low, high = np.array(WORKSPACE).T
    assert (cloud[:, :2] >= low[:2] - 1e-6).all()
    assert (cloud <= high + 1e-6).all()


def test_a_point_cloud_depends_on_the_scene_only():
    surfaces = [SceneMesh(random_boxes(np.random.default_rng(3), 3))]
    lenses = side_lenses(CENTER, 0.3)
    first, second = (point_cloud(surfaces, lenses, 500, WORKSPACE) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert len(np.unique(first, axis=0)) == 500


def test_a_point_cloud_larger_than_the_visible_points_repeats_them_evenly():
    narrow = ((0.44, 0.46), (-0.01, 0.01), (0.0, 0.2))
    lenses = side_lenses(CENTER, 0.3)
    seen = visible_points([SceneMesh([])], lenses, 200, (*narrow[:2], (-1.0, 1.0)))
    cloud = point_cloud([SceneMesh([])], lenses, 20_000, narrow)
    assert 0 < len(seen) < 5000
    unique, counts = np.unique(cloud, axis=0, return_counts=True)
    assert len(cloud) == 20_000
    assert len(unique) == len(seen)
    assert counts.max() - counts.min() <= 1


def test_a_point_cloud_without_visible_points_is_an_error():
    with pytest.raises(ValueError, match="see nothing"):
        point_cloud([SceneMesh([])], side_lenses(CENTER, 0.3), 10, ((5, 6), (5, 6), (0, 1)))


def test_points_of_the_floor_are_lower_in_a_recess():
    goal = PosedShape(
        Decal(size_m=(0.09, 0.09, 1e-3), recess_depth_m=0.02), ((0.5, 0.04, 0), (0, 0, 0, 1))
    )
    points = visible_points(
        [SceneMesh([goal])], side_lenses(CENTER, 0.3), 100, (*WORKSPACE[:2], (-1.0, 1.0))
    )
    inside = (np.abs(points[:, 0] - 0.5) < 0.045) & (np.abs(points[:, 1] - 0.04) < 0.045)
    assert 100 < inside.sum() < len(points)
    np.testing.assert_allclose(points[:, 2], np.where(inside, -0.02, 0.0), atol=1e-12)


def test_empty_pixels_take_the_height_of_the_nearest_point():
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(0, 1, (40, 2)), rng.uniform(0, 0.1, 40)])
    image = splat_heightmap(points, (0.5, 0.5), 1.0, 24)
    filled = {}
    for x, y, z in points:
        key = (math.floor(x * 24), math.floor(y * 24))
        filled[key] = max(filled.get(key, -1.0), z)
    for i in range(24):
        for j in range(24):
            distance = {key: (key[0] - i) ** 2 + (key[1] - j) ** 2 for key in filled}
            nearest = min(distance.values())
            assert image[i, j] in [filled[key] for key in filled if distance[key] == nearest]
    assert not splat_heightmap(points[:0], (0.5, 0.5), 1.0, 8).any()
