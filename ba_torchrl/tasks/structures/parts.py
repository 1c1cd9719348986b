"""The pieces of the open-loop structures; sizes are multiples of a block's edge (appendix A.1)."""

from __future__ import annotations

import math

from ba_torchrl.sim.bodies import Box, Color, Solid
from ba_torchrl.sim.meshes import centroid, gable_mesh, lathe_parts, moved
from ba_torchrl.tasks.base import Spot
from ba_torchrl.tasks.structures.blueprint import (
    CUBE,
    CUBOID,
    CYLINDER,
    CYLINDER_SIDES,
    ROOF,
    TRIANGLE,
    Piece,
    Span,
)
from ba_torchrl.tasks.structures.open_loop import Part

LENGTH = 4.0
"""Length of roof and cuboid."""
EAVES = 0.2
"""Height of a roof's upright sides: on slopes alone no two fingers hold it."""

RED: Color = (0.82, 0.22, 0.2, 1.0)
BLUE: Color = (0.2, 0.4, 0.8, 1.0)
GREEN: Color = (0.35, 0.7, 0.35, 1.0)
ORANGE: Color = (0.9, 0.55, 0.15, 1.0)

_SMALL, _LONG = 2.4, 3.4
"""Room around pieces."""


def cube(block_m: float) -> Part:
    """Return a cube."""
    return Part(
        CUBE, Box(size_m=(block_m,) * 3, color=RED), Spot(_SMALL * block_m, _SMALL * block_m)
    )


def cylinder(block_m: float) -> Part:
    """Return an upright cylinder, as high as it is wide."""
    radius, half = block_m / 2, block_m / 2
    (upright,) = lathe_parts(((radius, -half), (radius, half)), CYLINDER_SIDES)
    mesh = moved(upright, (0.0, 0.0, 0.0), math.pi / CYLINDER_SIDES)  # sides, not edges, across x
    return Part(
        CYLINDER, Solid(parts=(mesh,), color=ORANGE), Spot(_SMALL * block_m, _SMALL * block_m)
    )


def cuboid(block_m: float) -> Part:
    """Return a cuboid, its length along y."""
    box = Box(size_m=(block_m, LENGTH * block_m, block_m), color=BLUE)
    return Part(CUBOID, box, Spot(_LONG * block_m, _LONG * block_m))


def roof(block_m: float) -> Part:
    """Return a roof, its ridge along y."""
    return _gable(ROOF, (block_m, LENGTH * block_m, block_m), EAVES * block_m, _LONG * block_m)


def triangle(block_m: float) -> Part:
    """Return a triangle, its ridge along y."""
    return _gable(TRIANGLE, (block_m,) * 3, 0.0, _SMALL * block_m)


def pair_span(block_m: float, most: float) -> Span:
    """Return how far apart two supports of a bridge stand.

    Args:
        block_m: edge of a block.
        most: greatest distance of their centres, in blocks.
    """
    return Span(0.0, 1.75 * block_m, most * block_m)


def _gable(piece: Piece, size_m: tuple[float, float, float], eaves_m: float, room_m: float) -> Part:
    mesh = gable_mesh(size_m, eaves_m)
    shape = Solid(parts=(mesh,), color=GREEN, center_of_mass_m=centroid([mesh]))
    return Part(piece, shape, Spot(room_m, room_m))
