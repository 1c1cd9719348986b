"""The pieces of the structures: their kinds, and their shapes in multiples of a block's edge.

Appendix A.1.
"""

from __future__ import annotations

import math
from dataclasses import replace

from ba_torchrl.sim.geometry import Vector
from ba_torchrl.sim.meshes import centroid, gable_mesh, lathe_parts, transform_mesh
from ba_torchrl.sim.shapes import Box, Color, Shape, Solid
from ba_torchrl.tasks.base import BLUE, GREEN, ORANGE, RED
from ba_torchrl.tasks.structures.blueprint import Piece, Span
from ba_torchrl.tasks.workspace import Spacing

LENGTH = 4.0
"""Length of roof and cuboid, in blocks."""
EAVES = 0.2
"""Height of a roof's vertical sides, in blocks. Fingers cannot hold it by its slopes alone."""
CYLINDER_SIDES = 16
"""Number of sides of the polygon that approximates the circle."""


SHORT_SPACING, LONG_SPACING = 2.4, 3.4
"""Space at the start, in blocks, around pieces one block long, and around roof and cuboid."""


# -- kinds -------------------------------------------------------------------------------------


def _both(*axes: Vector) -> tuple[Vector, ...]:
    """Return each axis and its reverse."""
    return tuple(tuple(sign * x for x in axis) for axis in axes for sign in (1.0, -1.0))


_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)

CUBE = Piece("cube", math.pi / 2, (0.0, math.pi / 2), _both(_X, _Y, _Z))
CUBOID = Piece("cuboid", math.pi, (0.0,), _both(_X, _Z))
"""A box, longest along y."""
ROOF = Piece("roof", math.pi, (0.0,), stays_upright=True)
"""A long gable with its ridge along y. The fingers close on its eaves."""
TRIANGLE = Piece("triangle", math.pi, (math.pi / 2,), stays_upright=True)
"""A short gable with its ridge along y. The fingers close on its vertical ends."""
CYLINDER = Piece(
    "cylinder",
    2 * math.pi / CYLINDER_SIDES,
    tuple(2 * math.pi * i / CYLINDER_SIDES for i in range(CYLINDER_SIDES // 2)),
    _both(_Z),
    stays_upright=True,
)
"""An upright cylinder with two of its sides perpendicular to x. On its side it rolls."""


# -- pieces with a shape -----------------------------------------------------------------------


def cube(block_m: float, color: Color = RED) -> Piece:
    """Return a cube."""
    return _shaped(CUBE, Box(size_m=(block_m,) * 3, color=color), SHORT_SPACING * block_m)


def cylinder(block_m: float) -> Piece:
    """Return an upright cylinder, as high as it is wide."""
    radius, half = block_m / 2, block_m / 2
    (upright,) = lathe_parts(((radius, -half), (radius, half)), CYLINDER_SIDES)
    # rotated by half a side, so that sides and not edges are perpendicular to x
    mesh = transform_mesh(upright, (0.0, 0.0, 0.0), math.pi / CYLINDER_SIDES)
    return _shaped(CYLINDER, Solid(parts=(mesh,), color=ORANGE), SHORT_SPACING * block_m)


def cuboid(block_m: float) -> Piece:
    """Return a cuboid, longest along y."""
    shape = Box(size_m=(block_m, LENGTH * block_m, block_m), color=BLUE)
    return _shaped(CUBOID, shape, LONG_SPACING * block_m)


def roof(block_m: float) -> Piece:
    """Return a roof with its ridge along y."""
    shape = _gable((block_m, LENGTH * block_m, block_m), EAVES * block_m)
    return _shaped(ROOF, shape, LONG_SPACING * block_m)


def triangle(block_m: float) -> Piece:
    """Return a triangle with its ridge along y."""
    return _shaped(TRIANGLE, _gable((block_m,) * 3, 0.0), SHORT_SPACING * block_m)


def pair_span(block_m: float, most: float) -> Span:
    """Return the distance between the two supports of a bridge.

    Args:
        most: largest distance of their centres, in blocks.
    """
    return Span(0.0, 1.75 * block_m, most * block_m)


def _shaped(piece: Piece, shape: Shape, spacing_m: float) -> Piece:
    """Return a piece with a shape and the space around it at the start."""
    return replace(piece, shape=shape, spacing=Spacing(spacing_m, spacing_m))


def _gable(size_m: Vector, eaves_m: float) -> Solid:
    mesh = gable_mesh(size_m, eaves_m)
    return Solid(parts=(mesh,), color=GREEN, center_of_mass_m=centroid([mesh]))
