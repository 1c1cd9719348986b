"""The tray that clutter lies in, and other close-loop tasks on request (appendix, table 4)."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from ba_torchrl.sim.bodies import Color, Solid
from ba_torchrl.sim.meshes import Mesh
from ba_torchrl.sim.world import World

FLOOR_Z_M = 2e-3
MARGIN_M = 0.05
"""The flat floor is this much narrower than the workspace; lip and walls lie beyond."""
LIP_M = 0.015
LIP_RAD = math.radians(20)
WALL_RAD = math.radians(45)
RIM_Z_M = 0.1
UNDERGROUND_M = 0.05
"""The tray reaches down below the floor: what falls fast passes through a thin sheet."""
FLOOR_FRICTION = 0.5
WALL_FRICTION = 0.0

COLOR: Color = (0.72, 0.7, 0.66, 1.0)
FLOOR_COLOR: Color = (0.8, 0.79, 0.76, 1.0)


def profile(width_m: float) -> list[tuple[float, float]]:
    """Return the tray's cross-section from the floor's edge to the rim.

    Args:
        width_m: of the workspace.

    Returns:
        Distances from the middle and heights, metres.
    """
    inner = (width_m - MARGIN_M) / 2
    lip = (inner + LIP_M, FLOOR_Z_M + LIP_M * math.tan(LIP_RAD))
    rim = (lip[0] + (RIM_Z_M - lip[1]) / math.tan(WALL_RAD), RIM_Z_M)
    return [(inner, FLOOR_Z_M), lip, rim]


def add_tray(world: World, center_xy: tuple[float, float], width_m: float) -> float:
    """Put a tray on the floor: a flat base, a gentle lip and steep walls without friction.

    Args:
        world: not sealed yet.
        center_xy: middle of the workspace, metres.
        width_m: of the workspace.

    Returns:
        The height of the tray's floor, metres.
    """
    corners = profile(width_m)
    inner = corners[0][0]
    base = _slab(np.array([[s * inner, t * inner] for s, t in _SIGNS]), [FLOOR_Z_M] * 4)
    walls = [_wall(start, end, side) for side in range(4) for start, end in pairwise(corners)]
    for name, parts, friction, color in (
        ("tray floor", (base,), FLOOR_FRICTION, FLOOR_COLOR),
        ("tray walls", tuple(walls), WALL_FRICTION, COLOR),
    ):
        shape = Solid(parts=parts, mass_kg=0.0, friction=friction, color=color)
        world.add(shape, name).place((*center_xy, 0.0))
    return FLOOR_Z_M


_SIGNS = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def _wall(start: tuple[float, float], end: tuple[float, float], side: int) -> Mesh:
    """Return the part of one side between two points of the profile, mitred at the corners."""
    (r0, z0), (r1, z1) = start, end
    outline = np.array([(r0, -r0), (r1, -r1), (r1, r1), (r0, r0)])
    cos, sin = (1, 0, -1, 0)[side], (0, 1, 0, -1)[side]
    return _slab(outline @ np.array([[cos, sin], [-sin, cos]]), [z0, z1, z1, z0])


def _slab(outline: np.ndarray, heights: list[float]) -> Mesh:
    """Return the solid under a quadrilateral.

    Args:
        outline: [4, 2] corners, counter-clockwise from above.
        heights: of the corners.
    """
    bottom = np.column_stack([outline, np.full(4, -UNDERGROUND_M)])
    top = np.column_stack([outline, heights])
    quads = [(3, 2, 1, 0), (4, 5, 6, 7)] + [
        (i, (i + 1) % 4, (i + 1) % 4 + 4, i + 4) for i in range(4)
    ]
    faces = [tri for a, b, c, d in quads for tri in ((a, b, c), (a, c, d))]
    return Mesh(np.vstack([bottom, top]), np.array(faces, dtype=np.int64))
