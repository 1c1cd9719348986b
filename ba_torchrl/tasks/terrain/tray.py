"""The tray of the object-grasping tasks, optional in other close-loop tasks (table 4)."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Matrix
from ba_torchrl.sim.meshes import Mesh
from ba_torchrl.sim.robots.gripper import Gripper
from ba_torchrl.sim.shapes import Color, Solid
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.terrain.flat import Terrain
from ba_torchrl.tasks.workspace import Workspace

FLOOR_Z_M = 2e-3
"""Height of the base."""
MARGIN_M = 0.05
"""Workspace's width minus the base's, which lip and walls surround."""
LIP_M = 0.015
"""Horizontal extent of the lip."""
LIP_RAD = math.radians(20)
"""Slope of the lip."""
WALL_RAD = math.radians(45)
"""Slope of the walls."""
RIM_Z_M = 0.1
"""Height of the rim."""
UNDERGROUND_M = 0.05
"""Depth of the tray below the ground. Fast objects would pass through a thin sheet."""
FLOOR_FRICTION = 0.5
WALL_FRICTION = 0.0

COLOR: Color = (0.72, 0.7, 0.66, 1.0)
FLOOR_COLOR: Color = (0.8, 0.79, 0.76, 1.0)


def profile(width_m: float) -> list[tuple[float, float]]:
    """Return the cross-section of the tray from the edge of the base to the rim.

    Args:
        width_m: width of the workspace.

    Returns:
        Distances from the centre and heights, metres.
    """
    inner = (width_m - MARGIN_M) / 2
    lip = (inner + LIP_M, FLOOR_Z_M + LIP_M * math.tan(LIP_RAD))
    rim = (lip[0] + (RIM_Z_M - lip[1]) / math.tan(WALL_RAD), RIM_Z_M)
    return [(inner, FLOOR_Z_M), lip, rim]


class Tray(Terrain):
    """A tray on the floor: a flat base, a lip with a low slope and steep walls without friction.

    Args:
        world: not sealed yet; the tray is loaded as two static bodies.
        workspace: the tray has its centre and width.
    """

    def __init__(self, world: World, workspace: Workspace) -> None:
        super().__init__(world, workspace)
        corners = profile(workspace.width)
        self.half_m = corners[0][0]
        """Half the width of the base."""
        base = _slab(
            np.array([[s * self.half_m, t * self.half_m] for s, t in _SIGNS]), [FLOOR_Z_M] * 4
        )
        walls = [_wall(start, end, side) for side in range(4) for start, end in pairwise(corners)]
        self._base = self._add("tray floor", (base,), FLOOR_FRICTION, FLOOR_COLOR)
        self._add("tray walls", tuple(walls), WALL_FRICTION, COLOR)

    def _add(self, name: str, parts: tuple[Mesh, ...], friction: float, color: Color) -> Body:
        shape = Solid(parts=parts, mass_kg=0.0, friction=friction, color=color)
        body = self.world.add(shape, name)
        body.place((*self.workspace.center, 0.0))
        return body

    @property
    def support_ids(self) -> frozenset[int]:
        """PyBullet id of the base."""
        return frozenset((self._base.id,))

    def height_m(self, xy: tuple[float, float]) -> float:
        """Return the height of the base, metres."""
        return FLOOR_Z_M

    def lowest_tool_m(
        self,
        gripper: Gripper,
        xy: tuple[float, float],
        rotation: Matrix | None = None,
        opening: float = 1.0,
    ) -> float:
        """Return the least height of the tool, metres, at which the fingertips reach the ground.

        This is lower than on other terrains by the height of the base. Otherwise more picks of flat
        objects fail: of 200 picks without yaw 167 succeed instead of 175.
        """
        return gripper.lowest_tool_m(rotation, opening)


_SIGNS = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def _wall(start: tuple[float, float], end: tuple[float, float], side: int) -> Mesh:
    """Return one side of the tray between two points of the profile, with mitred corners."""
    (r0, z0), (r1, z1) = start, end
    outline = np.array([(r0, -r0), (r1, -r1), (r1, r1), (r0, r0)])
    cos, sin = (1, 0, -1, 0)[side], (0, 1, 0, -1)[side]
    return _slab(outline @ np.array([[cos, sin], [-sin, cos]]), [z0, z1, z1, z0])


def _slab(outline: np.ndarray, heights: list[float]) -> Mesh:
    """Return the solid below a quadrilateral.

    Args:
        outline: [4, 2] corners, counter-clockwise from above.
        heights: heights of the corners, metres.
    """
    bottom = np.column_stack([outline, np.full(4, -UNDERGROUND_M)])
    top = np.column_stack([outline, heights])
    quads = [(3, 2, 1, 0), (4, 5, 6, 7)] + [
        (i, (i + 1) % 4, (i + 1) % 4 + 4, i + 4) for i in range(4)
    ]
    faces = [tri for a, b, c, d in quads for tri in ((a, b, c), (a, c, d))]
    return Mesh(np.vstack([bottom, top]), np.array(faces, dtype=np.int64))
