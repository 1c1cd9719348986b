"""Pushes and pulls at objects of a heap that cannot be grasped as they lie."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Vector, YawPose
from ba_torchrl.tasks.clutter.grasp_planner import PIXEL_M, GraspPlanner
from ba_torchrl.tasks.clutter.tray import Tray
from ba_torchrl.tasks.workspace import ActionLimits

BEHIND_M = 5.5e-3
"""Room between a surface and the closed fingers that are about to push it."""
PRESS_M = 1.5e-3
DIG_M = 0.006
OBJECT_HALF_M = 0.045
WALL_ROOM_M = 0.05
"""Objects this near to a wall leave no room for a finger behind them."""
OVER_FLOOR_M = 4.4e-3
"""Height of the fingertips above the floor while they push."""
HAND_ROOM_M = 3e-3
"""Room under the hand, beside the fingers."""
FLAT_M = 0.01
"""Where the height image is lower, the floor is free."""
NEAR_M = 0.018
"""Fingers this near to the start of a push are there."""

ENDS = (-0.9, -0.6, -0.3, 0.0, 0.3, 0.6, 0.9)
SLIDING_RADIUS_M = 0.02
"""Mean distance from its centre of the friction under an object."""
DRAG_COST = 8.0
CRAMPED_COST = 12.0
"""Of a nudge that takes the hand into a wall or another object: better than none."""


class Push(NamedTuple):
    """A way with closed fingers that turns or moves an object, pushing its side or its top."""

    start: Vector
    end: Vector
    slack_m: float
    """Fingers this far above the start are there."""
    cost: float


class PushPlanner:
    """Finds the handiest nudge in a heap.

    Args:
        grasps: knows the objects, and how well they can be grasped.
        tray: holds them.
    """

    def __init__(self, grasps: GraspPlanner, tray: Tray) -> None:
        self._grasps = grasps
        self._tray = tray
        gripper = grasps.gripper
        self._tip_m = gripper.tip_height_m(0.0)
        """Height at which the closed fingers end, above the tool point."""
        self._standoff_m = gripper.closed_half_m + BEHIND_M
        """A push starts this far from the surface."""
        self._hand = np.array([p for p in gripper.closed_outline if p[0] > self._standoff_m])
        """Distances from the tool and heights above it of what is wider than the fingers."""
        floor_m = tray.height_m(grasps.workspace.center)
        self._low_m = max(grasps.workspace.z[0], floor_m + OVER_FLOOR_M - self._tip_m)

    def plan(
        self, bodies: Sequence[Body], tool: YawPose, limits: ActionLimits, heights: np.ndarray
    ) -> Push | None:
        """Return the handiest nudge of any of the bodies, or None if there is none.

        Args:
            bodies: to choose from.
            tool: where the gripper is.
            limits: of one action.
            heights: from `GraspPlanner.heights`.
        """
        pushes = [push for body in bodies for push in self._pushes(body, tool, limits, heights)]
        pushes += [push for body in bodies for push in self._pulls(body, tool, limits, heights)]
        return min(pushes, key=lambda push: push.cost, default=None)

    def _pushes(
        self, body: Body, tool: YawPose, limits: ActionLimits, heights: np.ndarray
    ) -> Iterator[Push]:
        """Yield pushes against a body's side, away from the walls.

        For a gripper that cannot turn, those that turn the body into its grasp.
        """
        middle = np.array(self._grasps.workspace.center)
        samples = self._grasps.placed_samples(body)
        center = samples[:, :2].mean(axis=0)
        low, band_half = self._low_m, self._grasps.band_half_m
        shares, lengths = ((0.0, -0.7, 0.7), (1.0,)) if limits.turn_rad else (ENDS, (0.5, 1.0))
        for turn in np.arange(8) * np.pi / 4:
            ahead = np.array([math.cos(turn), math.sin(turn)])
            side = np.array([-ahead[1], ahead[0]])
            along, across = ((samples[:, :2] - center) @ axis for axis in (ahead, side))
            for offset in np.array(shares) * np.abs(across).max():
                met = np.abs(across - offset) < band_half
                if not met.any():
                    continue
                start = center + (along[met].min() - self._standoff_m) * ahead + offset * side
                if not self._is_free(start, heights):
                    continue
                travel = _travel(start, low + NEAR_M, tool, limits)
                for length in lengths:
                    end = start + length * limits.step_m * ahead
                    # a body that slides flat turns about a point beyond its centre
                    push = length * limits.step_m - (self._standoff_m - band_half)
                    share = SLIDING_RADIUS_M**2 / (SLIDING_RADIUS_M**2 + offset**2)
                    pushed = center + share * push * ahead
                    if not self._is_on_floor(pushed, OBJECT_HALF_M):
                        continue
                    cost = travel - (math.dist(center, middle) - math.dist(pushed, middle)) / 0.05
                    if not limits.turn_rad:
                        angle = -offset * push / (SLIDING_RADIUS_M**2 + offset**2)
                        moved = _turned_about(samples, center, angle)
                        cost += 3 * self._grasps.risk_alone(moved, tool)
                    if not all(self._hand_fits(p, low, tool[1], heights) for p in (start, end)):
                        cost += CRAMPED_COST
                    yield Push((*start, low), (*end, low), NEAR_M, cost)

    def _pulls(
        self, body: Body, tool: YawPose, limits: ActionLimits, heights: np.ndarray
    ) -> Iterator[Push]:
        """Yield a pull at the top of a body by a wall towards the middle.

        Fingers stick better than the floor, and the walls are without friction.
        """
        middle = np.array(self._grasps.workspace.center)
        points = self._grasps.placed_samples(body)
        center = points[:, :2].mean(axis=0)
        if self._is_on_floor(center, WALL_ROOM_M):
            return
        near = np.linalg.norm(points[:, :2] - center, axis=1) < 0.01
        top = float(points[near, 2].max() if near.any() else points[:, 2].max())
        if self._height_at(center, heights) > top + 0.005:
            return  # something lies on it
        touching = top - self._tip_m
        start = (*center, touching - PRESS_M)
        way = (middle - center) / np.abs(middle - center).max() * limits.step_m
        cost = DRAG_COST + _travel(center, touching + PRESS_M, tool, limits)
        if not self._hand_fits(center, touching - DIG_M, tool[1], heights):
            cost += CRAMPED_COST
        yield Push(start, (*(center + way), touching - DIG_M), 3 * PRESS_M, cost)

    def _height_at(self, point: np.ndarray, heights: np.ndarray) -> float:
        i, j = ((point - self._grasps.corner) / PIXEL_M).astype(int)
        return float(heights[i, j])

    def _is_free(self, point: np.ndarray, heights: np.ndarray) -> bool:
        """Whether closed fingers fit at a point of the floor."""
        if not self._is_on_floor(point, self._grasps.band_half_m):
            return False
        i, j = ((point - self._grasps.corner) / PIXEL_M).astype(int)
        half = round(self._standoff_m / PIXEL_M) - 2
        window = heights[i - half : i + half + 1, j - half : j + half + 1]
        return float(window.max()) < FLAT_M

    def _hand_fits(
        self, point: np.ndarray, z_m: float, yaw_rad: float, heights: np.ndarray
    ) -> bool:
        """Whether the hand stays above walls and others with the tool at a place."""
        beside = np.outer(self._hand[:, 0], (math.cos(yaw_rad), math.sin(yaw_rad)))
        places = point + np.concatenate([beside, -beside])
        pixels = ((places - self._grasps.corner) / PIXEL_M).astype(int)
        i, j = np.clip(pixels, 0, len(heights) - 1).T
        return bool((heights[i, j] + HAND_ROOM_M < z_m + np.tile(self._hand[:, 1], 2)).all())

    def _is_on_floor(self, point: np.ndarray, margin_m: float) -> bool:
        """Whether a point is off the tray's walls by a margin."""
        half = self._tray.half_m - margin_m
        return float(np.abs(point - self._grasps.workspace.center).max()) < half


def _turned_about(samples: np.ndarray, center_xy: np.ndarray, angle_rad: float) -> np.ndarray:
    """Return points and normals [N, 6] turned about a vertical line."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    turn = np.array([[cos, -sin], [sin, cos]])
    out = samples.copy()
    out[:, :2] = (samples[:, :2] - center_xy) @ turn.T + center_xy
    out[:, 3:5] = samples[:, 3:5] @ turn.T
    return out


def _travel(start: np.ndarray, low_z: float, tool: YawPose, limits: ActionLimits) -> float:
    """Return about how many actions it takes to get closed fingers to the start of a nudge."""
    (x, y, z), _ = tool
    aside = float(np.abs(start - (x, y)).max())
    return 0.0 if aside <= NEAR_M and z <= low_z else 2.0 + aside / limits.step_m
