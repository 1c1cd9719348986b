"""Gripper: the dimensions of a robot's gripper, measured on its collision shapes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ba_torchrl.sim.geometry import Matrix, downward

FLOOR_CLEARANCE_M = 1e-3
"""Clearance between the closing fingertips and the floor."""
GRASP_HEIGHT_M = 0.02
"""Height above the tool point up to which the fingers are beside a grasped object."""
TIP_HEIGHT_M = 0.01
"""Height of the lowest part of the fingers, which is considered as the fingertips."""

_SIDES = np.array([-1.0, 1.0])
"""Of the tool point, along the closing axis."""
_EDGES = np.array([-1.0, 0.0, 1.0])
"""Of a fingertip and its centre line, perpendicular to the closing axis."""


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
        """Return the distance of the fingers' outer sides below a height above the tool point."""
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
        """Return points [N, 3] of the surface of both fingers on their path as they close, metres.

        They are on the lower faces of the fingertips and on the outer sides of the fingers,
        relative to the tool point, along the axes of the world. A rotation of None points straight
        down; ``opening`` is that before the fingers close.
        """
        rotation = downward(0.0) if rotation is None else rotation
        return _tip_points_of_tool(self, opening) @ np.array(rotation).T

    def lowest_tool_m(self, rotation: Matrix | None = None, opening: float = 1.0) -> float:
        """Return the least height of the tool at which the fingers close clear of the floor.

        Fingers that rotate move down as they close, so that the height depends on the opening
        before. A rotation of None points straight down.
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
