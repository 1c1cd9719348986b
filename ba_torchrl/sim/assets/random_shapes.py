"""A choice of the random shapes that come with PyBullet."""

from __future__ import annotations

from collections.abc import Sequence
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
WIDEST_M = 0.055
"""Shapes are shrunk until the narrowest width of each of their rests is at most this."""
FLATTEST_M = 0.018
"""Least height of any rest; the fingers need something to hold."""
LONGEST_M = 0.11
LEAST_SQUARE = 0.9
"""Least squareness of any rest: fingers slip off wedges and domes."""
LEAST_FILL = 0.6
"""Least share of its convex hull that a shape fills: the hull is what is simulated and seen."""

# fmt: off
CHOICE: tuple[tuple[int, float], ...] = (
    (0, 0.63), (1, 0.61), (5, 0.58), (21, 0.60), (39, 0.61), (51, 0.59), (59, 0.73), (80, 0.64),
    (81, 0.62), (126, 0.66), (136, 0.65), (146, 0.60), (155, 0.62), (183, 0.64), (200, 0.59),
    (205, 0.60), (207, 0.61), (208, 0.58), (211, 0.62), (220, 0.63), (228, 1.00), (233, 0.63),
    (243, 1.00), (245, 0.60), (249, 0.66), (305, 0.62), (306, 0.63), (311, 0.61), (313, 0.63),
    (333, 0.71), (335, 0.61), (340, 0.60), (344, 0.59), (346, 0.61), (363, 0.62), (364, 0.59),
    (368, 0.59), (391, 0.60), (410, 0.58), (412, 0.62), (414, 0.60), (422, 0.60), (441, 0.65),
    (485, 1.00), (491, 0.61), (499, 0.59), (511, 1.00), (520, 0.71), (521, 0.60), (527, 0.68),
    (531, 0.58), (532, 0.60), (550, 0.66), (571, 0.58), (589, 0.59), (599, 0.63), (601, 0.64),
    (623, 0.63), (631, 0.59), (649, 1.00), (651, 0.67), (666, 0.58), (684, 0.65), (687, 0.60),
    (698, 0.65), (702, 0.67), (714, 0.60), (723, 0.60), (735, 0.58), (738, 0.62), (742, 0.59),
    (749, 0.69), (755, 0.64), (759, 1.00), (766, 0.61), (798, 0.59), (812, 0.59), (813, 0.64),
    (826, 0.66), (878, 0.61), (899, 0.59), (910, 0.59), (912, 0.65), (920, 0.67), (966, 0.59),
    (977, 0.62),
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
        """Return the convex hull, which is what PyBullet makes of such a mesh anyway."""
        number, scale = CHOICE[index]
        content = shape_path(number).read_bytes()

        def hull() -> list[Mesh]:
            return [convex_hull(read_shape(number)[0])]

        (unscaled,) = cached_parts(content, "hull of a random shape", hull)
        return (Mesh(unscaled.vertices * scale, unscaled.faces),)


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
            faces += [(corners[0], b, c) for b, c in zip(corners[1:], corners[2:], strict=False)]
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
