"""The pieces of the improvised houses: random shapes instead of cubes (appendix A.1, figure 12).

No bodies can be added to a sealed world. Several sizes of every shape are therefore loaded into a
pool, from which every episode draws.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from ba_torchrl.sim.assets.cache import Decomposition, cached_parts
from ba_torchrl.sim.assets.hulls import convex_hull, surface_samples, volume_and_center
from ba_torchrl.sim.assets.random_shapes import UNIT_M, read_shape, shape_path
from ba_torchrl.sim.meshes import Mesh
from ba_torchrl.sim.shapes import Box, Color, Shape, Solid
from ba_torchrl.tasks.base import BLUE
from ba_torchrl.tasks.structures.blueprint import Piece, Span
from ba_torchrl.tasks.structures.pieces import CUBOID

NUMBERS = (2, 5, 27, 32, 66, 75, 83, 116, 118, 131, 137, 142, 143, 149, 154, 176, 187, 199, 200)
"""PyBullet's numbers of the shapes of figure 12."""
SIZES = 3
"""Number of sizes of each shape."""
CUBOIDS = 12
"""Number of random cuboids in the pool."""
SHAPE_UNIT_M = 0.01
"""Metres per unit of a mesh file at scale 1."""
WIDE = (0.6, 0.9)
"""Range of the horizontal scale."""
HIGH = (1.2, 1.32)
"""Range of the vertical scale, for heights of 2.5 to 3 cm."""
CUBOID_M = ((0.025, 0.035), (0.075, 0.105), (0.02, 0.035))
"""Range of each edge of a random cuboid."""
SHAPE_GAP_M = (-0.02, 0.008, 0.02)
"""Gap between the two shapes under a bridge, along the line between their centres: least, from
the expert, largest. It is negative if the shapes stand obliquely side by side."""
START_GAP_M = 0.015
"""Least gap between the bounding circles of two pieces at the start."""
SAMPLES = 4000
"""Number of sampled points of a surface."""
CONTACT_DEPTH_M = 2e-3
"""Depth behind the outermost point in which surface points touch a finger."""
PATCH_HALF_M = 0.0095
"""Half the width and half the height of the patch of a surface that touches a finger."""
WIDTH_WEIGHT = 2.0
"""Cost of a metre between the fingers, relative to the cosine between surfaces and fingers."""
ORANGE: Color = (0.9, 0.55, 0.2, 1.0)

SHAPE = Piece("object", stays_upright=True)
"""Any of the random shapes. One on its side supports nothing, and no top-down pick turns it
upright."""
UP = ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
"""The sides on which a random shape may lie."""


@cache
def any_shape() -> Piece:
    """Return the piece with all random shapes as its variants."""
    return replace(SHAPE, variants=tuple(shape_piece(shape) for _, shape in random_shapes()))


def any_cuboid() -> Piece:
    """Return the piece with all random cuboids as its variants."""
    return replace(CUBOID, variants=tuple(replace(CUBOID, shape=box) for box in random_cuboids()))


def shape_span() -> Span:
    """Return the distance between the two shapes under a bridge."""
    least, aim, most = SHAPE_GAP_M
    return Span(least, aim, most, gap_m=aim)


def random_shapes() -> list[tuple[int, Solid]]:
    """Return number and solid of each shape in all sizes, evenly spaced over the ranges."""
    found = []
    for k, number in enumerate(NUMBERS):
        hull = _hull(number)
        for size in range(SIZES):
            # the order of the heights differs between shapes, so that width and height vary apart
            wide = _interpolate(WIDE, (size + 0.5) / SIZES)
            high = _interpolate(HIGH, ((size + k) % SIZES + 0.5) / SIZES)
            vertices = hull.vertices * (wide, wide, high) * SHAPE_UNIT_M
            center = np.array(volume_and_center(Mesh(vertices, hull.faces))[1])
            mid_z = (vertices[:, 2].min() + vertices[:, 2].max()) / 2
            mesh = Mesh(vertices - (*center[:2], mid_z), hull.faces)
            solid = Solid(
                parts=(mesh,), color=ORANGE, center_of_mass_m=(0.0, 0.0, float(center[2] - mid_z))
            )
            found.append((number, solid))
    return found


def random_cuboids() -> list[Shape]:
    """Return cuboids with random edges; every call returns the same ones."""
    low, high = np.array(CUBOID_M).T
    sizes = np.random.default_rng(0).uniform(low, high, (CUBOIDS, 3))
    return [Box(size_m=tuple(size), color=BLUE) for size in sizes.tolist()]


def shape_piece(shape: Shape) -> Piece:
    """Return the piece of a random shape.

    Its grasp yaw is the one at which the surfaces that touch the fingers are closest to parallel to
    them, less a cost of the width between the fingers.
    """
    points, normals = surface_samples(shape.mesh(), SAMPLES)
    level = np.abs(points[:, 2]) < PATCH_HALF_M
    points, normals = points[level, :2], normals[level, :2]

    def quality(yaw: float) -> float:
        axis = np.array([math.cos(yaw), math.sin(yaw)])
        in_patch = np.abs(points @ (-axis[1], axis[0])) < PATCH_HALF_M
        along, facing = points[in_patch] @ axis, normals[in_patch]
        first = facing[along < along.min() + CONTACT_DEPTH_M].mean(axis=0)
        last = facing[along > along.max() - CONTACT_DEPTH_M].mean(axis=0)
        cosine = min(-first @ last, -first @ axis, last @ axis)
        return float(cosine - WIDTH_WEIGHT * np.ptp(along))

    yaws = (np.arange(-18, 18) * math.pi / 36).tolist()
    return replace(
        SHAPE,
        yaw_period_rad=math.pi,
        grasp_yaws_rad=(max(yaws, key=quality),),
        up=UP,
        shape=shape,
    )


def _hull(number: int) -> Mesh:
    """Return the convex hull of a shape, in the units of its file."""

    def make() -> Decomposition:
        mesh = read_shape(number)
        return Decomposition((convex_hull(mesh.vertices / UNIT_M),))

    content = shape_path(number).read_bytes()
    return cached_parts(content, "hull, units of the file", make).parts[0]


def _interpolate(ends: tuple[float, float], share: float) -> float:
    low, high = ends
    return low + share * (high - low)
