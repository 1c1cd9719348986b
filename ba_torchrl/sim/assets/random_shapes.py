"""A choice of the random shapes that come with PyBullet."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pybullet_data

from ba_torchrl.sim.assets.base import OBJECT_SETS, ObjectSet
from ba_torchrl.sim.assets.cache import cached_parts
from ba_torchrl.sim.assets.hulls import convex_hull, rests, volume_and_center
from ba_torchrl.sim.meshes import Mesh

UNIT_M = 0.015
"""Metres per unit of the mesh files, as their URDF files have it."""
COUNT = 86
WIDEST_M = 0.06
"""Shapes are shrunk until the narrowest width of each of their rests is at most this."""
FLATTEST_M = 0.02
"""Least height of any rest; the fingers need something to hold."""
LONGEST_M = 0.11
LEAST_SQUARE = 0.85
"""Least squareness of any rest: fingers slip off wedges and domes."""
LEAST_FILL = 0.6
"""Least share of its convex hull that a shape fills: the hull is what is simulated and seen."""

# fmt: off
CHOICE: tuple[tuple[int, float], ...] = (
    (1, 0.66), (5, 0.63), (34, 0.67), (39, 0.67), (51, 0.64), (59, 0.80), (66, 0.66), (74, 1.00),
    (80, 0.70), (81, 0.67), (101, 0.71), (122, 0.70), (137, 0.65), (146, 0.65), (159, 0.65),
    (165, 0.65), (179, 0.65), (181, 0.75), (200, 0.65), (207, 0.66), (211, 0.68), (225, 0.67),
    (228, 1.00), (237, 0.64), (239, 0.67), (243, 1.00), (275, 0.65), (279, 0.65), (305, 0.68),
    (306, 0.69), (311, 0.66), (313, 0.69), (333, 0.77), (335, 0.66), (340, 0.66), (344, 0.64),
    (391, 0.65), (412, 0.68), (431, 0.68), (434, 0.68), (461, 0.67), (462, 0.63), (466, 0.63),
    (475, 0.69), (485, 1.00), (499, 0.64), (502, 0.66), (514, 0.64), (520, 0.77), (532, 0.66),
    (539, 0.68), (550, 0.72), (551, 0.65), (555, 0.64), (574, 0.64), (589, 0.65), (617, 0.66),
    (623, 0.69), (626, 0.72), (649, 1.00), (651, 0.73), (666, 0.64), (698, 0.71), (702, 0.73),
    (713, 0.65), (714, 0.65), (723, 0.65), (738, 0.68), (742, 0.65), (752, 0.63), (755, 0.70),
    (766, 0.66), (798, 0.64), (808, 0.64), (813, 0.70), (826, 0.72), (828, 1.00), (843, 0.64),
    (878, 0.66), (886, 0.69), (899, 0.64), (911, 0.73), (912, 0.71), (948, 0.65), (977, 0.68),
    (986, 1.00),
)
# fmt: on
"""Number and scale of each shape, as `choose` works them out."""


class Candidate(NamedTuple):
    """A shape that suits."""

    scale: float
    features: tuple[float, ...]
    """What tells shapes apart: the extents in ascending order, each in units of 5 cm, and twice
    the share of its bounding box that it fills."""


@OBJECT_SETS.register("random")
class RandomShapes(ObjectSet):
    """86 of PyBullet's 1000 random shapes: graspable however they lie, and unlike each other."""

    @property
    def names(self) -> Sequence[str]:
        """Their numbers in PyBullet's collection."""
        return [f"{number:03d}" for number, _ in CHOICE]

    def parts(self, index: int) -> tuple[Mesh, ...]:
        """Return the convex hull, which is what PyBullet makes of such a mesh anyway.

        It stands on the facet, and with the yaw, that suit a gripper at yaw 0 best.
        """
        number, scale = CHOICE[index]

        def hull() -> list[Mesh]:
            vertices, faces = convex_hull(read_shape(number).vertices * scale)
            best = max(rests(Mesh(vertices, faces)), key=lambda rest: rest.squareness)
            return [Mesh(vertices @ best.turn.T, faces)]

        return cached_parts(shape_path(number).read_bytes(), f"random shape 2 {scale}", hull)


def shape_path(number: int) -> Path:
    """Return the mesh file of a random shape, 0 to 999."""
    return Path(pybullet_data.getDataPath(), "random_urdfs", f"{number:03d}", f"{number:03d}.obj")


def read_shape(number: int) -> Mesh:
    """Return the mesh of a random shape in metres, at its original size."""
    vertices, faces = [], []
    for line in shape_path(number).read_text().splitlines():
        kind, *values = line.split() or [""]
        if kind == "v":
            vertices.append([float(value) for value in values[:3]])
        elif kind == "f":
            corners = [int(value.split("/")[0]) - 1 for value in values]
            faces += [(corners[0], b, c) for b, c in pairwise(corners[1:])]
    return Mesh(np.array(vertices) * UNIT_M, np.array(faces, dtype=np.int64))


def examine(number: int) -> Candidate | None:
    """Return at which scale a random shape can be grasped however it lies, or None if at none."""
    mesh = read_shape(number)
    try:
        hull = convex_hull(mesh.vertices)
    except ValueError:
        return None  # one of the files has coordinates that are not numbers
    volume = volume_and_center(hull)[0]
    poses = rests(hull)
    if not poses or volume_and_center(mesh)[0] < LEAST_FILL * volume:
        return None
    scale = min(1.0, WIDEST_M / max(rest.width_m for rest in poses))
    scale = float(np.floor(scale * 100) / 100)
    poses = rests(Mesh(hull.vertices * scale, hull.faces))
    extents = np.sort(np.ptp(hull.vertices, axis=0))
    if (
        scale * extents[-1] > LONGEST_M
        or not poses
        or min(rest.height_m for rest in poses) < FLATTEST_M
        or min(rest.squareness for rest in poses) < LEAST_SQUARE
    ):
        return None
    return Candidate(scale, (*(extents * scale / 0.05), 2 * volume / float(np.prod(extents))))


def choose() -> tuple[tuple[int, float], ...]:
    """Choose the shapes: of those that suit, again and again the one most unlike the chosen."""
    found = {number: examine(number) for number in range(1000)}
    numbers = [number for number, candidate in found.items() if candidate is not None]
    points = np.array([found[number].features for number in numbers])
    chosen = [0]
    distances = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < COUNT:
        chosen.append(int(distances.argmax()))
        distances = np.minimum(distances, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return tuple((numbers[i], found[numbers[i]].scale) for i in sorted(chosen))
