"""Gripper: the dimensions of a robot's gripper, measured on its collision shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Protocol

import numpy as np
import pybullet

from ba_torchrl.sim.geometry import Matrix, Vector, YawPose, downward
from ba_torchrl.sim.world import World

FLOOR_CLEARANCE_M = 1e-3
"""Clearance between the closing fingertips and the floor."""
GRASP_HEIGHT_M = 0.02
"""Height above the tool point up to which the fingers are beside a grasped object."""
TIP_HEIGHT_M = 0.01
"""Height of the lowest part of the fingers, which is considered as the fingertips."""

_OPENINGS = tuple(np.linspace(0.0, 1.0, 9).tolist())
_OUTLINE_SPACING_M = 5e-3
_RAY_SPACING_M = 1e-3
_MAX_U_M, _MAX_V_M = 0.14, 0.02
_RAY_START_BELOW_M, _RAY_END_ABOVE_M = 0.05, 0.1
_CHAMFER_M = 2e-3
_RAYS_AT_ONCE = 8192
_POSITION = (0.45, 0.0, 0.25)
_SIDES = np.array([-1.0, 1.0])
"""Of the tool point, along the closing axis."""
_EDGES = np.array([-1.0, 0.0, 1.0])
"""Of a fingertip and its centre line, perpendicular to the closing axis."""


class MeasurableRobot(Protocol):
    """The part of the interface of `Robot` that the measurement uses."""

    id: int
    client: int
    world: World

    def __init__(self, world: World) -> None: ...

    def inverse_kinematics(self, position: Vector, rotation: Matrix) -> list[float] | None:
        """Return the arm joints for a pose of the tool."""

    def teleport(self, joints: Sequence[float]) -> None:
        """Set the arm joints, with zero velocities."""

    def set_opening(self, opening: float) -> None:
        """Set the opening of the fingers, 0 to 1, with zero velocities."""

    def tool_pose(self) -> YawPose:
        """Return the position and yaw of the tool."""


@dataclass(frozen=True)
class Gripper:
    """Dimensions and lower outline of a gripper that points straight down.

    Distances are measured from the tool point along the closing axis, the line along which the
    fingers close; the gripper is symmetric. Heights are relative to the tool point.
    """

    half_gap_m: float
    """Half the distance between the open fingers."""
    half_width_m: float
    """Half the width of the fingertips, perpendicular to the closing axis."""
    closed_half_m: float
    """Half the extent of the two closed fingertips along the closing axis."""
    palm_height_m: float
    """Height of the palm: the lowest part above the gap between the fingers at any opening."""
    tip_arc: tuple[tuple[float, float], ...]
    """Pairs of half the distance between the fingers, from closed to open, and the height of the
    fingertips at this opening. Fingers that rotate move down as they close."""
    outline: tuple[tuple[float, float], ...]
    """Pairs of distance, ascending from zero, and height of the open gripper's lower surface."""
    closed_outline: tuple[tuple[float, float], ...]
    """The same for the closed gripper."""

    @property
    def finger_depth_m(self) -> float:
        """Extent of a fingertip along the closing axis."""
        return self.closed_half_m - self.tip_arc[0][0]

    @cached_property
    def finger_reach_m(self) -> float:
        """Distance of the outer side of the open fingers, up to `GRASP_HEIGHT_M`."""
        return self.finger_reach_below_m(GRASP_HEIGHT_M)

    @cached_property
    def lowest_tip_m(self) -> float:
        """Least height of the fingertips at any opening."""
        return min(z for _, z in self.tip_arc)

    def finger_reach_below_m(self, height_m: float, opening: float = 1.0) -> float:
        """Return the distance of the fingers' outer sides below a height.

        Args:
            height_m: above the tool point.
            opening: of the fingers, 0 to 1.
        """
        reach_m = self.half_gap_m + self.finger_depth_m
        if height_m > self.tip_height_m(self.half_gap_m) + TIP_HEIGHT_M:
            reach_m = max([reach_m, *(u for u, z in self.outline if z < height_m)])
        return reach_m - (1 - opening) * self.half_gap_m

    def closed_reach_m(self, height_m: float) -> float:
        """Return the largest distance of the closed gripper below a height."""
        return max((u for u, z in self.closed_outline if z < height_m), default=0.0)

    def tip_height_m(self, half_gap_m: float) -> float:
        """Return the height of the fingertips for half the distance between the fingers."""
        gaps, heights = zip(*self.tip_arc, strict=True)
        return float(np.interp(half_gap_m, gaps, heights))

    def tip_points(self, rotation: Matrix | None = None, opening: float = 1.0) -> np.ndarray:
        """Return points of the surface of both fingers on their path as they close.

        They are on the lower faces of the fingertips and on the outer sides of the fingers.

        Args:
            rotation: of the tool; None means straight down.
            opening: of the fingers before they close, 0 to 1.

        Returns:
            [N, 3] metres, relative to the tool point, along the axes of the world.
        """
        rotation = downward(0.0) if rotation is None else rotation
        return _tip_points_of_tool(self, opening) @ np.array(rotation).T

    def lowest_tool_m(self, rotation: Matrix | None = None, opening: float = 1.0) -> float:
        """Return the least height of the tool at which the fingers close clear of the floor.

        Fingers that rotate move down as they close, so that the height depends on the opening.

        Args:
            rotation: of the tool; None means straight down.
            opening: of the fingers before they close, 0 to 1.

        Returns:
            Height of the tool point above the floor, metres.
        """
        along, across, ahead = (0.0, 0.0, -1.0) if rotation is None else rotation[2]
        widest = max(opening * self.half_gap_m, self.tip_arc[0][0])
        depths = [
            abs(along) * min(gap, widest) + abs(across) * self.half_width_m + ahead * height
            for gap, height in self.tip_arc
        ]
        return max(depths) + FLOOR_CLEARANCE_M


@lru_cache(maxsize=64)
def _tip_points_of_tool(gripper: Gripper, opening: float) -> np.ndarray:
    """Return the points of `Gripper.tip_points` in the frame of the tool, [N, 3] metres."""
    widest = max(opening * gripper.half_gap_m, gripper.tip_arc[0][0])
    depth_m = gripper.finger_depth_m
    gaps, tips = np.array(gripper.tip_arc).T
    depths = np.array([0.0, depth_m / 2, depth_m, depth_m, depth_m])
    heights = np.array([0.0, 0.0, 0.0, GRASP_HEIGHT_M, 2 * GRASP_HEIGHT_M])
    points = np.empty((len(gaps), len(depths), len(_SIDES), len(_EDGES), 3))
    along = np.minimum(gaps, widest)[:, None] + depths
    points[..., 0] = along[:, :, None, None] * _SIDES[:, None]
    points[..., 1] = _EDGES * gripper.half_width_m
    points[..., 2] = (-tips[:, None] - heights)[:, :, None, None]
    return points.reshape(-1, 3)


@cache
def measured_gripper(robot: type[MeasurableRobot]) -> Gripper:
    """Return the gripper of a robot class, measured once per process.

    The measurement casts rays from below in a temporary world, which takes tenths of a second. The
    rays hit the collision shapes including their margins, as contacts do.
    """
    us = np.arange(0.0, _MAX_U_M + _RAY_SPACING_M / 2, _RAY_SPACING_M)
    vs = np.arange(-_MAX_V_M, _MAX_V_M + _RAY_SPACING_M / 2, _RAY_SPACING_M)
    with World() as world:
        body = robot(world)
        body.teleport(body.inverse_kinematics(_POSITION, downward(0.0)))
        closed, opened = (_underside(body, opening, us, vs) for opening in (0.0, 1.0))
        lines = [_underside(body, opening, us, np.zeros(1))[:, 0] for opening in _OPENINGS]

    tip_arc, palm = [], np.inf
    for heights in lines:
        gap = us[_are_tips(heights)].min()
        tip_arc.append((float(gap), float(heights.min())))
        palm = min([palm, *heights[us < gap - _CHAMFER_M]])
    tips = _are_tips(opened)
    return Gripper(
        half_gap_m=tip_arc[-1][0],
        half_width_m=float(np.abs(vs[tips.any(axis=0)]).max()) + _RAY_SPACING_M / 2,
        closed_half_m=float(us[_are_tips(closed).any(axis=1)].max()) + _RAY_SPACING_M / 2,
        palm_height_m=float(palm),
        tip_arc=tuple(tip_arc),
        outline=_outline(us, opened),
        closed_outline=_outline(us, closed),
    )


def _outline(us: np.ndarray, heights: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Return pairs of distance and least height around it, up to the end of the gripper."""
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
    """Return the least height [U, V] of the gripper above the tool point.

    Args:
        robot: a robot whose tool points straight down.
        opening: of the fingers, 0 to 1.
        us: [U] distances along the closing axis, taken on both sides of the tool point.
        vs: [V] coordinates perpendicular to the closing axis.

    Returns:
        The lower of the two sides; infinity where no ray hits the gripper.
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
