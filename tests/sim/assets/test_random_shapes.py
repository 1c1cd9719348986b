"""The random shapes: the criterion of their choice, and their pose."""

from typing import NamedTuple

import numpy as np
import pytest

from ba_torchrl.sim.assets import hulls
from ba_torchrl.sim.assets.base import load_object_set
from ba_torchrl.sim.assets.hulls import convex_hull, stable_poses, volume_and_center
from ba_torchrl.sim.assets.random_shapes import SELECTION, read_shape
from ba_torchrl.sim.meshes import Mesh

NUM_SHAPES = 86
MAX_WIDTH_M = 0.06
"""Shapes are scaled down until the width of every stable pose is at most this."""
MIN_HEIGHT_M = 0.02
"""Least height in any stable pose, so that fingers can grasp the shape."""
MAX_LENGTH_M = 0.11
MIN_ANTIPODAL_SCORE = 0.82
"""Least antipodal score of any stable pose: fingers slip off wedges and domes."""
MIN_FILL = 0.6
"""Least ratio of a shape's volume to that of its convex hull, which replaces it."""


class Candidate(NamedTuple):
    """A shape that satisfies the limits above."""

    scale: float
    features: tuple[float, ...]
    """Features for diversity: the extents in ascending order, in units of 5 cm, and twice the ratio
    of the volume to that of the bounding box."""


def scaled_candidate(number: int) -> Candidate | None:
    """Return the scale at which a random shape is graspable in every stable pose.

    It is None if the shape does not satisfy the limits at any scale.
    """
    mesh = read_shape(number)
    try:
        hull = convex_hull(mesh.vertices)
    except ValueError:
        return None  # one of the files contains NaN coordinates
    volume = volume_and_center(hull)[0]
    poses = stable_poses(hull)
    if not poses or volume_and_center(mesh)[0] < MIN_FILL * volume:
        return None
    scale = min(1.0, MAX_WIDTH_M / max(pose.width_m for pose in poses))
    scale = float(np.floor(scale * 100) / 100)
    poses = stable_poses(Mesh(hull.vertices * scale, hull.faces))
    extents = np.sort(np.ptp(hull.vertices, axis=0))
    if (
        scale * extents[-1] > MAX_LENGTH_M
        or not poses
        or min(pose.height_m for pose in poses) < MIN_HEIGHT_M
        or min(pose.antipodal_score for pose in poses) < MIN_ANTIPODAL_SCORE
    ):
        return None
    return Candidate(scale, (*(extents * scale / 0.05), 2 * volume / float(np.prod(extents))))


def select_shapes() -> tuple[tuple[int, float], ...]:
    """Select diverse shapes among the candidates by farthest-point sampling of their features."""
    found = {number: scaled_candidate(number) for number in range(1000)}
    numbers = [number for number, candidate in found.items() if candidate is not None]
    points = np.array([found[number].features for number in numbers])
    selected = [0]
    distances = np.linalg.norm(points - points[0], axis=1)
    while len(selected) < NUM_SHAPES:
        selected.append(int(distances.argmax()))
        distances = np.minimum(distances, np.linalg.norm(points - points[selected[-1]], axis=1))
    return tuple((numbers[i], found[numbers[i]].scale) for i in sorted(selected))


def test_chosen_random_shapes_have_the_recorded_scale():
    for number, scale in SELECTION[::20]:
        found = scaled_candidate(number)
        assert found is not None
        assert found.scale == scale


def test_unsuitable_random_shapes_are_refused(monkeypatch):
    assert scaled_candidate(168) is None  # its file contains NaN
    number, _ = SELECTION[0]
    for limit, value in (("MAX_LENGTH_M", 0.01), ("MIN_HEIGHT_M", 0.2), ("MIN_FILL", 1.01)):
        with monkeypatch.context() as patch:
            patch.setitem(globals(), limit, value)
            assert scaled_candidate(number) is None


@pytest.mark.slow
def test_the_choice_of_random_shapes_follows_from_the_criterion():
    assert select_shapes() == SELECTION


def test_random_shapes_stand_so_that_fingers_fit_at_yaw_zero():
    for shape in load_object_set("random")[::6]:
        low, high = shape.bounds_m
        vertices = shape.mesh().vertices
        across = vertices[np.abs(vertices[:, 1]) < hulls.FINGER_HALF_WIDTH_M]
        assert len(across) == 0 or np.ptp(across[:, 0]) <= hulls.MAX_GAP_M + 1e-3
        assert high[2] - low[2] >= MIN_HEIGHT_M - 1e-6
