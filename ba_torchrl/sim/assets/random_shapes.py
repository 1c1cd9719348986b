"""A selection of the random shapes that PyBullet's data package contains."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pybullet_data

from ba_torchrl.sim.assets.base import OBJECT_SETS, ObjectSet
from ba_torchrl.sim.assets.cache import Decomposition, cached_parts
from ba_torchrl.sim.assets.hulls import convex_hull, stable_poses
from ba_torchrl.sim.meshes import Mesh, merge_meshes, read_obj

UNIT_M = 0.015
"""Metres per unit of the mesh files; their URDF files contain this scale."""
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
"""Number and scale of each selected shape, which is graspable in every stable pose.

`tests/sim/assets/test_random_shapes.py` selects them."""


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
    """Return the mesh file of a random shape, 0 to 999."""
    return Path(pybullet_data.getDataPath(), "random_urdfs", f"{number:03d}", f"{number:03d}.obj")


def read_shape(number: int) -> Mesh:
    """Return the mesh of a random shape at its original size, metres."""
    vertices, faces = merge_meshes(read_obj(shape_path(number).read_bytes()))
    return Mesh(vertices * UNIT_M, faces)
