"""The outline of a robot's gripper, measured on its collision shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
import pybullet

from ba_torchrl.sim.geometry import Matrix, Vector, YawPose, downward
from ba_torchrl.sim.world import World

FLOOR_CLEARANCE_M = 1e-3
"""Distance that fingertips keep from the floor while they close."""
GRASP_HEIGHT_M = 0.02
"""Height above the tool point up to which fingers are beside what they grasp."""
TIP_HEIGHT_M = 0.01
"""The lowest part of the fingers, which counts as their tips."""

_OPENINGS = tuple(np.linspace(0.0, 1.0, 9).tolist())
_OUTLINE_SPACING_M = 5e-3
_RAY_SPACING_M = 1e-3
_MAX_U_M, _MAX_V_M = 0.14, 0.02
_RAY_START_BELOW_M, _RAY_END_ABOVE_M = 0.05, 0.1
_CHAMFER_M = 2e-3
_RAYS_AT_ONCE = 8192
_POSITION = (0.45, 0.0, 0.25)


class MeasurableRobot(Protocol):
    """What the measurement needs of a `Robot`."""

    id: int
    client: int
    world: World

    def __init__(self, world: World) -> None: ...

    def inverse_kinematics(self, position: Vector, rotation: Matrix) -> list[float] | None:
        """Return arm joints that bring the tool to a pose."""

    def teleport(self, joints: Sequence[float]) -> None:
        """Put the arm at rest at joint angles."""

    def set_opening(self, opening: float) -> None:
        """Put the fingers at rest at an opening from 0 to 1."""

    def tool_pose(self) -> YawPose:
        """Return the tool point and the gripper's yaw."""


@dataclass(frozen=True)
class Gripper:
    """Outline of a gripper that points down, as things beneath it meet it.

    Distances are from the tool point along the line on which the fingers close, the same on both
    sides; heights are above the tool point.
    """

    half_gap_m: float
    """Half the distance between the open fingers."""
    half_width_m: float
    """Half the fingertips' width, across the line on which they close."""
    closed_half_m: float
    """Half the extent of both fingertips along that line when they are closed."""
    palm_height_m: float
    """Height of the lowest part over the gap between the fingers, however wide it is."""
    arc: tuple[tuple[float, float], ...]
    """Half gaps from closed to open, and the height at which the fingers end there: those that
    swing go down as they close."""
    outline: tuple[tuple[float, float], ...]
    """Distances, ascending from zero, and the height at which the open gripper begins there."""
    closed_outline: tuple[tuple[float, float], ...]
    """The same of the closed gripper."""

    @property
    def finger_depth_m(self) -> float:
        """Extent of a fingertip along the line on which the fingers close."""
        return self.closed_half_m - self.arc[0][0]

    @property
    def finger_reach_m(self) -> float:
        """Distance from the tool point to the outside of the open fingers, where they grasp."""
        tips_m = self.half_gap_m + self.finger_depth_m
        return max([tips_m, *(u for u, z in self.outline if z < GRASP_HEIGHT_M)])

    @property
    def lowest_tip_m(self) -> float:
        """Height at which the fingers end where their arc is lowest."""
        return min(z for _, z in self.arc)

    def closed_reach_m(self, height_m: float) -> float:
        """Return how far the closed hand reaches from the tool point below a height."""
        return max((u for u, z in self.closed_outline if z < height_m), default=0.0)

    def tip_height_m(self, half_gap_m: float) -> float:
        """Return the height at which the fingers end, given half the distance between them."""
        gaps, heights = zip(*self.arc, strict=True)
        return float(np.interp(half_gap_m, gaps, heights))

    def lowest_tool_m(self, rotation: Matrix | None = None, opening: float = 1.0) -> float:
        """Return how low the tool may be for the fingers to close without touching the floor.

        Those that swing go down as they close: on the floor they would close against it.

        Args:
            rotation: of the tool; if None, it points down.
            opening: how far the fingers are open at the start, 0 to 1.

        Returns:
            Height of the tool point above the floor, metres.
        """
        along, across, ahead = (0.0, 0.0, -1.0) if rotation is None else rotation[2]
        widest = max(opening * self.half_gap_m, self.arc[0][0])
        depths = [
            abs(along) * min(gap, widest) + abs(across) * self.half_width_m + ahead * height
            for gap, height in self.arc
        ]
        return max(depths) + FLOOR_CLEARANCE_M


@cache
def measured_gripper(robot: type[MeasurableRobot]) -> Gripper:
    """Return the outline of a robot's gripper.

    Rays from below find the collision shapes as contacts do, their margins included. It takes a
    world of its own and tenths of a second, once in a process.
    """
    us = np.arange(0.0, _MAX_U_M + _RAY_SPACING_M / 2, _RAY_SPACING_M)
    vs = np.arange(-_MAX_V_M, _MAX_V_M + _RAY_SPACING_M / 2, _RAY_SPACING_M)
    with World() as world:
        body = robot(world)
        body.teleport(body.inverse_kinematics(_POSITION, downward(0.0)))
        closed, opened = (_underside(body, opening, us, vs) for opening in (0.0, 1.0))
        lines = [_underside(body, opening, us, np.zeros(1))[:, 0] for opening in _OPENINGS]

    arc, palm = [], np.inf
    for heights in lines:
        gap = us[_are_tips(heights)].min()
        arc.append((float(gap), float(heights.min())))
        palm = min([palm, *heights[us < gap - _CHAMFER_M]])
    tips = _are_tips(opened)
    return Gripper(
        half_gap_m=arc[-1][0],
        half_width_m=float(np.abs(vs[tips.any(axis=0)]).max()) + _RAY_SPACING_M / 2,
        closed_half_m=float(us[_are_tips(closed).any(axis=1)].max()) + _RAY_SPACING_M / 2,
        palm_height_m=float(palm),
        arc=tuple(arc),
        outline=_outline(us, opened),
        closed_outline=_outline(us, closed),
    )


def _outline(us: np.ndarray, heights: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Return the lowest heights around every few millimetres of the way out, as far as they go."""
    profile = heights.min(axis=1)
    reach = us[np.isfinite(profile)].max()
    return tuple(
        (float(u), float(profile[np.abs(us - u) < _OUTLINE_SPACING_M / 2].min()))
        for u in np.arange(0.0, reach + _OUTLINE_SPACING_M / 2, _OUTLINE_SPACING_M)
    )


def _are_tips(heights: np.ndarray) -> np.ndarray:
    return heights < heights.min() + TIP_HEIGHT_M


def _underside(
    robot: MeasurableRobot, opening: float, us: np.ndarray, vs: np.ndarray
) -> np.ndarray:
    """Return heights [U, V] above the tool at which rays from below meet the gripper.

    Both sides count, and infinity stands for nothing there.
    """
    robot.set_opening(opening)
    robot.world.detect_collisions()
    (x, y, z), _ = robot.tool_pose()
    grid = np.stack(np.meshgrid(np.concatenate([us, -us]), vs, indexing="ij"), -1).reshape(-1, 2)
    low, high = (
        np.column_stack([grid + np.array([x, y]), np.full(len(grid), z + height)])
        for height in (-_RAY_START_BELOW_M, _RAY_END_ABOVE_M)
    )
    hits = [
        hit
        for i in range(0, len(grid), _RAYS_AT_ONCE)
        for hit in pybullet.rayTestBatch(
            low[i : i + _RAYS_AT_ONCE].tolist(),
            high[i : i + _RAYS_AT_ONCE].tolist(),
            physicsClientId=robot.client,
        )
    ]
    heights = np.array([hit[3][2] - z if hit[0] == robot.id else np.inf for hit in hits])
    return heights.reshape(2, len(us), len(vs)).min(axis=0)
