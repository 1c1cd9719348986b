"""A selection of the random shapes that PyBullet's data package contains."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pybullet_data

from ba_torchrl.sim.assets.base import OBJECT_SETS, ObjectSet
from ba_torchrl.sim.assets.cache import Decomposition, cached_parts
from ba_torchrl.sim.assets.hulls import convex_hull, stable_poses, volume_and_center
from ba_torchrl.sim.meshes import Mesh, merge_meshes, read_obj

UNIT_M = 0.015
"""Metres per unit of the mesh files; their URDF files contain this scale."""
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

# fmt: off
SELECTION: tuple[tuple[int, float], ...] = (
    (2, 0.64), (5, 0.63), (23, 1.00), (39, 0.67), (66, 0.66), (74, 1.00), (81, 0.67), (114, 0.64),
    (137, 0.65), (146, 0.65), (149, 0.64), (179, 0.65), (195, 0.66), (200, 0.65), (207, 0.66),
    (220, 0.69), (228, 1.00), (229, 0.69), (243, 1.00), (258, 0.63), (261, 0.64), (279, 0.65),
    (288, 0.64), (305, 0.68), (308, 0.64), (335, 0.66), (366, 0.64), (368, 0.65), (371, 0.64),
    (372, 0.66), (385, 0.64), (410, 0.64), (412, 0.68), (431, 0.68), (443, 0.64), (466, 0.63),
    (474, 0.65), (475, 0.69), (485, 1.00), (502, 0.66), (511, 1.00), (520, 0.77), (527, 0.74),
    (535, 0.64), (536, 0.65), (537, 0.64), (539, 0.68), (550, 0.72), (574, 0.64), (623, 0.69),
    (631, 0.65), (634, 0.65), (636, 0.65), (649, 1.00), (666, 0.64), (687, 0.65), (702, 0.73),
    (715, 0.65), (729, 0.64), (743, 0.64), (749, 0.75), (752, 0.63), (757, 0.64), (759, 1.00),
    (761, 0.76), (763, 0.64), (808, 0.64), (828, 1.00), (862, 0.64), (866, 0.64), (870, 0.64),
    (894, 0.68), (899, 0.64), (906, 0.64), (910, 0.65), (912, 0.71), (921, 0.65), (943, 0.68),
    (955, 0.64), (958, 0.64), (965, 0.65), (966, 0.65), (974, 0.65), (986, 1.00), (989, 0.64),
    (998, 0.65),
)
# fmt: on
"""Number and scale of each selected shape: the result of `select_shapes`."""


class Candidate(NamedTuple):
    """A shape that satisfies the limits above."""

    scale: float
    features: tuple[float, ...]
    """Features for diversity: the extents in ascending order, in units of 5 cm, and twice the ratio
    of the volume to that of the bounding box."""


@OBJECT_SETS.register("random")
class RandomShapes(ObjectSet):
    """86 of PyBullet's 1000 random shapes: diverse, and graspable in every stable pose."""

    @property
    def names(self) -> Sequence[str]:
        """Numbers of the shapes in PyBullet's data package."""
        return [f"{number:03d}" for number, _ in SELECTION]

    def parts(self, index: int) -> tuple[Mesh, ...]:
        """Return the convex hull of a shape, which PyBullet would also use for such a mesh.

        The hull is in its lowest stable pose, with the axis of the best grasp along x.
        """
        number, scale = SELECTION[index]

        def hull() -> Decomposition:
            vertices, faces = convex_hull(read_shape(number).vertices * scale)
            flattest = min(stable_poses(Mesh(vertices, faces)), key=lambda pose: pose.height_m)
            return Decomposition((Mesh(vertices @ flattest.rotation.T, faces),))

        content = shape_path(number).read_bytes()
        return cached_parts(content, f"random shape 3 {scale}", hull).parts


def shape_path(number: int) -> Path:
    """Return the mesh file of a random shape."""
    return Path(pybullet_data.getDataPath(), "random_urdfs", f"{number:03d}", f"{number:03d}.obj")


def read_shape(number: int) -> Mesh:
    """Return the mesh of a random shape at its original size, metres."""
    vertices, faces = merge_meshes(read_obj(shape_path(number).read_bytes()))
    return Mesh(vertices * UNIT_M, faces)


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
