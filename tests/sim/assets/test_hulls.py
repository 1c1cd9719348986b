"""Convex hulls: volume, resting poses, surface samples."""

import numpy as np
import pytest

from ba_torchrl.sim.assets import hulls
from ba_torchrl.sim.meshes import box_mesh


def test_hull_of_a_box_with_points_inside_is_the_box():
    points = np.vstack([box_mesh((0.1, 0.2, 0.3)).vertices, [[0.01, 0.02, 0.03]]]) + 1.0
    hull = hulls.convex_hull(points)
    assert len(hull.vertices) == 8
    volume, center = hulls.volume_and_center(hull)
    assert volume == pytest.approx(0.1 * 0.2 * 0.3)  # negative if faces point inwards
    np.testing.assert_allclose(center, [1, 1, 1], atol=1e-12)


def test_center_of_a_cone_is_at_a_quarter_of_its_height():
    turns = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    base = np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1)
    hull = hulls.convex_hull(np.vstack([base, [[0, 0, 2.0]]]))
    np.testing.assert_allclose(hulls.volume_and_center(hull)[1], [0, 0, 0.5], atol=1e-9)


@pytest.mark.parametrize("points", [np.zeros((9, 3)), np.full((9, 3), np.nan), np.eye(3)])
def test_points_without_volume_have_no_hull(points):
    with pytest.raises(ValueError, match="no convex hull"):
        hulls.convex_hull(points)


def test_rests_of_a_box_are_its_six_faces():
    size = (0.03, 0.05, 0.07)
    found = hulls.stable_poses(hulls.convex_hull(box_mesh(size).vertices))
    assert sorted(round(rest.height_m, 6) for rest in found) == sorted(size * 2)
    for rest in found:
        least = min(set(size) - {round(rest.height_m, 6)})
        assert rest.width_m == pytest.approx(least, abs=1e-6)
        assert rest.antipodal_score > 0.9
        # in this pose the fingers close along x, and the height is along z
        extents = np.ptp(box_mesh(size).vertices @ rest.rotation.T, axis=0)
        assert extents[2] == pytest.approx(rest.height_m)
        assert extents[0] <= hulls.MAX_GAP_M + 1e-3
        assert np.linalg.det(rest.rotation) == pytest.approx(1)


def test_a_wedge_is_less_square_than_a_box():
    wedge = np.array([(x, y, z) for x, y in ((0, -0.03), (0, 0.03), (0.04, 0)) for z in (0, 0.03)])
    flat = [rest for rest in hulls.stable_poses(hulls.convex_hull(wedge)) if rest.height_m < 0.031]
    assert flat
    assert all(rest.antipodal_score < 0.8 for rest in flat)


def test_a_body_does_not_rest_on_an_end_it_would_topple_from():
    leaning = box_mesh((0.02, 0.02, 0.1)).vertices.copy()
    leaning[leaning[:, 2] > 0, 0] += 0.06
    heights = [rest.height_m for rest in hulls.stable_poses(hulls.convex_hull(leaning))]
    assert heights
    assert max(heights) < 0.05


def test_samples_lie_on_the_surface_evenly():
    points, normals = hulls.surface_samples(box_mesh((0.1, 0.1, 0.2)), 1000)
    assert np.all(np.abs(points) <= np.array([0.05, 0.05, 0.1]) + 1e-12)
    outer = np.abs(points) > np.array([0.05, 0.05, 0.1]) - 1e-12
    assert np.all(outer.any(axis=1))
    assert np.all(np.einsum("ij,ij->i", points, normals) > 0)
    assert (np.abs(normals[:, 2]) > 0.5).mean() == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize("flattening", [1.0, 0.2])
def test_a_simplified_hull_is_near_the_hull(flattening):
    points = np.random.default_rng(0).normal(size=(5000, 3))
    points *= (1.0, 0.8, flattening) / np.linalg.norm(points, axis=1, keepdims=True)
    hull = hulls.convex_hull(points)
    simple = hulls.simplified_hull(hull)
    assert len(simple.vertices) <= hulls.MAX_HULL_VERTICES
    a, b, c = (simple.vertices[simple.faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    outside = hull.vertices @ normals.T - np.einsum("fi,fi->f", normals, a)
    assert 0 < outside.max() <= hulls.HULL_ERROR[1] * np.ptp(points, axis=0).max()


def test_a_hull_with_few_vertices_is_not_simplified():
    points = np.random.default_rng(0).normal(size=(hulls.MAX_HULL_VERTICES, 3))
    hull = hulls.convex_hull(points / np.linalg.norm(points, axis=1, keepdims=True))
    assert hulls.simplified_hull(hull) is hull


def test_more_vertices_are_kept_where_the_error_needs_it(monkeypatch):
    monkeypatch.setattr(hulls, "MAX_HULL_VERTICES", 200)
    monkeypatch.setattr(hulls, "HULL_ERROR", (1e-3, 2e-3))
    points = np.random.default_rng(0).normal(size=(1000, 3))
    hull = hulls.convex_hull(points / np.linalg.norm(points, axis=1, keepdims=True))
    assert 200 < len(hulls.simplified_hull(hull).vertices) < 1000
