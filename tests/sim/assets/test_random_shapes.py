"""The random shapes: the criterion of their choice, and their pose."""

from typing import NamedTuple

import numpy as np
import pytest

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


@pytest.mark.slow
def test_the_choice_of_random_shapes_follows_from_the_criterion():
    assert select_shapes() == SELECTION
