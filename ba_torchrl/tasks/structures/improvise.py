"""The pieces of the improvised houses: random shapes in place of cubes (appendix A.1, figure 12).

A world takes no new bodies once it is sealed, so a pool of shapes in several sizes is loaded at the
start, and every episode draws from it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ba_torchrl.sim.assets.cache import cached_parts
from ba_torchrl.sim.assets.hulls import convex_hull, surface_samples, volume_and_center
from ba_torchrl.sim.assets.random_shapes import UNIT_M, read_shape, shape_path
from ba_torchrl.sim.meshes import Mesh
from ba_torchrl.sim.shapes import Box, Color, Shape, Solid
from ba_torchrl.tasks.structures.blueprint import CUBOID, Piece, Span
from ba_torchrl.tasks.structures.parts import BLUE

NUMBERS = (2, 5, 27, 32, 66, 75, 83, 116, 118, 131, 137, 142, 143, 149, 154, 176, 187, 199, 200)
"""Shapes of figure 12, as PyBullet numbers them."""
SIZES = 3
"""Of each shape."""
CUBOIDS = 12
"""Random cuboids in the pool."""
SHAPE_UNIT_M = 0.01
"""Metres per unit of a mesh file at scale 1."""
WIDE = (0.6, 0.9)
"""Range of the horizontal scale."""
HIGH = (1.2, 1.32)
"""Range of the vertical scale, which gives heights of 2.5 to 3 cm."""
CUBOID_M = ((0.025, 0.035), (0.075, 0.105), (0.02, 0.035))
"""Range of each edge of a random cuboid."""
SHAPE_GAP_M = (-0.02, 0.008, 0.02)
"""Gap between two shapes next to each other, along the line between their centres: least, aimed
for, most. Below zero they stand side by side at an angle."""
START_GAP_M = 0.015
"""Least distance between the circles around two pieces at the start."""
SAMPLES = 4000
SKIN_M = 2e-3
"""Points of a surface that is sampled, and the depth of those that a finger meets."""
PATCH_HALF_M = 0.0095
"""Half the height, and half the width, of the patch of a surface that counts as met by a finger."""
WIDTH_WEIGHT = 2.0
"""What a metre of width costs, measured in cosines between sides and fingers."""
ORANGE: Color = (0.9, 0.55, 0.2, 1.0)

SHAPE = Piece("shape", stays_upright=True)
"""Any of the random shapes; one on its side carries nothing, and no pick about the vertical rights
it."""
UP = ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0))


def any_shape() -> Piece:
    """Return a piece that stands for any of the random shapes."""
    return replace(SHAPE, variants=tuple(shape_piece(shape) for _, shape in random_shapes()))


def any_cuboid() -> Piece:
    """Return a piece that stands for any of the random cuboids."""
    return replace(CUBOID, variants=tuple(replace(CUBOID, shape=box) for box in random_cuboids()))


def spread(piece: Piece) -> Piece:
    """Return a piece that needs no more space at the start than the circle around it."""
    return replace(piece, spot=None)


def shape_span() -> Span:
    """Return how two shapes stand next to each other."""
    least, aim, most = SHAPE_GAP_M
    return Span(least, aim, most, gap_m=aim)


def random_shapes() -> list[tuple[int, Solid]]:
    """Return number and body of each shape in each of its sizes, spread evenly over the ranges."""
    found = []
    for k, number in enumerate(NUMBERS):
        hull = _hull(number)
        for size in range(SIZES):
            # the heights go round, so that size and height are not tied
            wide = _share(WIDE, (size + 0.5) / SIZES)
            high = _share(HIGH, ((size + k) % SIZES + 0.5) / SIZES)
            vertices = hull.vertices * (wide, wide, high) * SHAPE_UNIT_M
            center = np.array(volume_and_center(Mesh(vertices, hull.faces))[1])
            middle = (vertices[:, 2].min() + vertices[:, 2].max()) / 2
            mesh = Mesh(vertices - (*center[:2], middle), hull.faces)
            solid = Solid(
                parts=(mesh,), color=ORANGE, center_of_mass_m=(0.0, 0.0, float(center[2] - middle))
            )
            found.append((number, solid))
    return found


def random_cuboids() -> list[Shape]:
    """Return cuboids of random edges, the same ones every time."""
    low, high = np.array(CUBOID_M).T
    sizes = np.random.default_rng(0).uniform(low, high, (CUBOIDS, 3))
    return [Box(size_m=tuple(size), color=BLUE) for size in sizes.tolist()]


def shape_piece(shape: Shape) -> Piece:
    """Return what a random shape is to a builder.

    It is held by its middle, at the yaw at which the sides that the fingers meet are most square
    to them, and narrow.
    """
    points, normals = surface_samples(shape.mesh(), SAMPLES)
    level = np.abs(points[:, 2]) < PATCH_HALF_M
    points, normals = points[level, :2], normals[level, :2]

    def quality(yaw: float) -> float:
        axis = np.array([math.cos(yaw), math.sin(yaw)])
        met = np.abs(points @ (-axis[1], axis[0])) < PATCH_HALF_M
        along, facing = points[met] @ axis, normals[met]
        first = facing[along < along.min() + SKIN_M].mean(axis=0)
        last = facing[along > along.max() - SKIN_M].mean(axis=0)
        square = min(-first @ last, -first @ axis, last @ axis)
        return float(square - WIDTH_WEIGHT * np.ptp(along))

    yaws = (np.arange(-18, 18) * math.pi / 36).tolist()
    return replace(
        SHAPE,
        yaw_period_rad=math.pi,
        grasp_yaws_rad=(max(yaws, key=quality),),
        up=UP,
        shape=shape,
    )


def _hull(number: int) -> Mesh:
    """Return the convex hull of a shape in the units of its file."""

    def make() -> list[Mesh]:
        mesh = read_shape(number)
        return [convex_hull(mesh.vertices / UNIT_M)]

    return cached_parts(shape_path(number).read_bytes(), "hull, units of the file", make)[0]


def _share(span: tuple[float, float], share: float) -> float:
    low, high = span
    return low + share * (high - low)
