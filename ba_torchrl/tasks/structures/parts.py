"""The pieces of the structures; sizes are multiples of a block's edge (appendix A.1)."""

from __future__ import annotations

import math
from dataclasses import replace

from ba_torchrl.sim.meshes import centroid, gable_mesh, lathe_parts, transform_mesh
from ba_torchrl.sim.shapes import Box, Color, Solid
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
from ba_torchrl.tasks.workspace import Spot

LENGTH = 4.0
"""Length of roof and cuboid."""
EAVES = 0.2
"""Height of a roof's upright sides: on slopes alone no two fingers hold it."""

RED: Color = (0.82, 0.22, 0.2, 1.0)
BLUE: Color = (0.2, 0.4, 0.8, 1.0)
GREEN: Color = (0.35, 0.7, 0.35, 1.0)
ORANGE: Color = (0.9, 0.55, 0.15, 1.0)

SHORT_SPOT, LONG_SPOT = 2.4, 3.4
"""Space at the start around pieces as long as a block, and around roof and cuboid."""


def cube(block_m: float, color: Color = RED) -> Piece:
    """Return a cube."""
    return replace(
        CUBE, shape=Box(size_m=(block_m,) * 3, color=color), spot=_spot(SHORT_SPOT * block_m)
    )


def cylinder(block_m: float) -> Piece:
    """Return an upright cylinder, as high as it is wide."""
    radius, half = block_m / 2, block_m / 2
    (upright,) = lathe_parts(((radius, -half), (radius, half)), CYLINDER_SIDES)
    mesh = transform_mesh(
        upright, (0.0, 0.0, 0.0), math.pi / CYLINDER_SIDES
    )  # sides, not edges, across x
    shape = Solid(parts=(mesh,), color=ORANGE)
    return replace(CYLINDER, shape=shape, spot=_spot(SHORT_SPOT * block_m))


def cuboid(block_m: float) -> Piece:
    """Return a cuboid, its length along y."""
    shape = Box(size_m=(block_m, LENGTH * block_m, block_m), color=BLUE)
    return replace(CUBOID, shape=shape, spot=_spot(LONG_SPOT * block_m))


def roof(block_m: float) -> Piece:
    """Return a roof, its ridge along y."""
    size_m = (block_m, LENGTH * block_m, block_m)
    return replace(ROOF, shape=_gable(size_m, EAVES * block_m), spot=_spot(LONG_SPOT * block_m))


def triangle(block_m: float) -> Piece:
    """Return a triangle, its ridge along y."""
    return replace(TRIANGLE, shape=_gable((block_m,) * 3, 0.0), spot=_spot(SHORT_SPOT * block_m))


def pair_span(block_m: float, most: float) -> Span:
    """Return how far apart two supports of a bridge stand.

    Args:
        block_m: edge of a block.
        most: greatest distance of their centres, in blocks.
    """
    return Span(0.0, 1.75 * block_m, most * block_m)


def _spot(space_m: float) -> Spot:
    return Spot(space_m, space_m)


def _gable(size_m: tuple[float, float, float], eaves_m: float) -> Solid:
    mesh = gable_mesh(size_m, eaves_m)
    return Solid(parts=(mesh,), color=GREEN, center_of_mass_m=centroid([mesh]))
