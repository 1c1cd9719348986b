"""Pushes and pulls of objects in a heap that cannot be grasped in their present pose."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Vector, YawPose
from ba_torchrl.tasks.clutter.grasp_planner import PIXEL_M, GraspPlanner
from ba_torchrl.tasks.terrain.tray import Tray
from ba_torchrl.tasks.workspace import ActionLimits

STANDOFF_M = 5.5e-3
"""Gap between an object and the closed fingers at the start of a push."""
PRESS_M = 1.5e-3
"""Depth of the fingertips below the top of an object at the start of a pull."""
PULL_DEPTH_M = 0.006
"""Depth of the fingertips below the top of an object at the end of a pull."""
OBJECT_HALF_M = 0.045
"""Least distance between the centre of a pushed object and the walls."""
WALL_CLEARANCE_M = 0.05
"""Distance from a wall below which a finger does not fit behind an object."""
FLOOR_CLEARANCE_M = 4.4e-3
"""Height of the fingertips above the floor during a push."""
HAND_CLEARANCE_M = 3e-3
"""Gap between the hand, beside the fingers, and objects and walls."""
FREE_FLOOR_M = 0.01
"""Height below which a pixel of the height image shows free floor."""
NEAR_M = 0.018
"""Largest offset of fingers that are at the start of a push."""

OFFSET_SHARES = (-0.9, -0.6, -0.3, 0.0, 0.3, 0.6, 0.9)
TURNING_OFFSET_SHARES = (0.0, -0.7, 0.7)
"""Offsets of a push from the centre of an object, as a multiple of its half width, without and with
yaw actions."""
SLIDING_RADIUS_M = 0.02
"""Mean distance of the friction forces below an object from its centre."""
PULL_COST = 8.0
"""Cost of a pull, in actions."""
COLLISION_COST = 12.0
"""Cost of a push or pull in which the hand touches a wall or another object, in actions."""


class Push(NamedTuple):
    """A straight motion of closed fingers that moves or turns an object by its side or top."""

    start: Vector
    end: Vector
    height_tolerance_m: float
    """Largest height above the start of fingers that are at the start."""
    cost: float
    """Expected number of actions, plus penalties."""


class PushPlanner:
    """Finds the push or pull with the lowest cost in a heap.

    Args:
        grasps: the grasp planner of the objects.
    """

    def __init__(self, grasps: GraspPlanner, tray: Tray) -> None:
        self._grasps = grasps
        self._tray = tray
        gripper = grasps.gripper
        self._tip_m = gripper.tip_height_m(0.0)
        """Height of the closed fingertips above the tool point."""
        self._standoff_m = gripper.closed_half_m + STANDOFF_M
        """Distance between the surface of an object and the tool at the start of a push."""
        self._hand = np.array([p for p in gripper.closed_outline if p[0] > self._standoff_m])
        """Distances from the tool, and heights above it, of the parts wider than the fingers."""
        floor_m = tray.height_m(grasps.workspace.center)
        self._low_m = max(grasps.workspace.z[0], floor_m + FLOOR_CLEARANCE_M - self._tip_m)
        """Height of the tool during a push."""

    def plan(
        self, bodies: Sequence[Body], tool: YawPose, limits: ActionLimits, heights: np.ndarray
    ) -> Push | None:
        """Return the push or pull of any of the bodies with the lowest cost; None without any.

        Args:
            heights: height image of `GraspPlanner.heights`.
        """
        pushes = [push for body in bodies for push in self._pushes(body, tool, limits, heights)]
        pushes += [push for body in bodies for push in self._pulls(body, tool, limits, heights)]
        return min(pushes, key=lambda push: push.cost, default=None)

    def _pushes(
        self, body: Body, tool: YawPose, limits: ActionLimits, heights: np.ndarray
    ) -> Iterator[Push]:
        """Yield pushes against the sides of a body.

        For a gripper that cannot turn, the cost is lower for pushes that turn the body to a better
        grasp.
        """
        tray_center = np.array(self._grasps.workspace.center)
        samples = self._grasps.placed_samples(body)
        center = samples[:, :2].mean(axis=0)
        low, band_half = self._low_m, self._grasps.band_half_m
        shares = TURNING_OFFSET_SHARES if limits.turn_rad else OFFSET_SHARES
        lengths = (1.0,) if limits.turn_rad else (0.5, 1.0)
        for bearing in np.arange(8) * np.pi / 4:
            ahead = np.array([math.cos(bearing), math.sin(bearing)])
            side = np.array([-ahead[1], ahead[0]])
            along, across = ((samples[:, :2] - center) @ axis for axis in (ahead, side))
            for offset in np.array(shares) * np.abs(across).max():
                in_band = np.abs(across - offset) < band_half
                if not in_band.any():
                    continue
                start = center + (along[in_band].min() - self._standoff_m) * ahead + offset * side
                if not self._is_free(start, heights):
                    continue
                travel = _travel(start, low + NEAR_M, tool, limits)
                for length in lengths:
                    end = start + length * limits.step_m * ahead
                    # planar sliding: a push off the centre both moves and turns the body
                    push = length * limits.step_m - (self._standoff_m - band_half)
                    share = SLIDING_RADIUS_M**2 / (SLIDING_RADIUS_M**2 + offset**2)
                    pushed = center + share * push * ahead
                    if not self._is_on_floor(pushed, OBJECT_HALF_M):
                        continue
                    inwards_m = math.dist(center, tray_center) - math.dist(pushed, tray_center)
                    cost = travel - inwards_m / 0.05
                    if not limits.turn_rad:
                        angle = -offset * push / (SLIDING_RADIUS_M**2 + offset**2)
                        moved = _rotated_about(samples, center, angle)
                        cost += 3 * self._grasps.risk_alone(moved, tool)
                    if not all(self._hand_fits(p, low, tool[1], heights) for p in (start, end)):
                        cost += COLLISION_COST
                    yield Push((*start, low), (*end, low), NEAR_M, cost)

    def _pulls(
        self, body: Body, tool: YawPose, limits: ActionLimits, heights: np.ndarray
    ) -> Iterator[Push]:
        """Yield a pull of a body near a wall, by its top, towards the centre of the tray.

        The fingers have more friction than the floor, and the walls have none.
        """
        tray_center = np.array(self._grasps.workspace.center)
        points = self._grasps.placed_samples(body)
        center = points[:, :2].mean(axis=0)
        if self._is_on_floor(center, WALL_CLEARANCE_M):
            return
        near = np.linalg.norm(points[:, :2] - center, axis=1) < 0.01
        top = float(points[near, 2].max() if near.any() else points[:, 2].max())
        i, j = ((center - self._grasps.corner) / PIXEL_M).astype(int)
        if heights[i, j] > top + 0.005:
            return  # another object lies on it
        contact_z = top - self._tip_m
        start = (*center, contact_z - PRESS_M)
        inwards = tray_center - center
        displacement = inwards / np.abs(inwards).max() * limits.step_m
        cost = PULL_COST + _travel(center, contact_z + PRESS_M, tool, limits)
        if not self._hand_fits(center, contact_z - PULL_DEPTH_M, tool[1], heights):
            cost += COLLISION_COST
        end = (*(center + displacement), contact_z - PULL_DEPTH_M)
        yield Push(start, end, 3 * PRESS_M, cost)

    def _is_free(self, point: np.ndarray, heights: np.ndarray) -> bool:
        """Whether the floor at a point is free for the closed fingers."""
        if not self._is_on_floor(point, self._grasps.band_half_m):
            return False
        i, j = ((point - self._grasps.corner) / PIXEL_M).astype(int)
        half = round(self._standoff_m / PIXEL_M) - 2
        window = heights[i - half : i + half + 1, j - half : j + half + 1]
        return float(window.max()) < FREE_FLOOR_M

    def _hand_fits(
        self, point: np.ndarray, z_m: float, yaw_rad: float, heights: np.ndarray
    ) -> bool:
        """Whether the hand is above walls and objects with the tool at a point."""
        beside = np.outer(self._hand[:, 0], (math.cos(yaw_rad), math.sin(yaw_rad)))
        points = point + np.concatenate([beside, -beside])
        pixels = ((points - self._grasps.corner) / PIXEL_M).astype(int)
        i, j = np.clip(pixels, 0, len(heights) - 1).T
        return bool((heights[i, j] + HAND_CLEARANCE_M < z_m + np.tile(self._hand[:, 1], 2)).all())

    def _is_on_floor(self, point: np.ndarray, margin_m: float) -> bool:
        """Whether a point is on the base of the tray, at least a margin from its edge."""
        half = self._tray.half_m - margin_m
        return float(np.abs(point - self._grasps.workspace.center).max()) < half


def _rotated_about(samples: np.ndarray, center_xy: np.ndarray, angle_rad: float) -> np.ndarray:
    """Return points and normals [N, 6] rotated about a vertical axis."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    turn = np.array([[cos, -sin], [sin, cos]])
    out = samples.copy()
    out[:, :2] = (samples[:, :2] - center_xy) @ turn.T + center_xy
    out[:, 3:5] = samples[:, 3:5] @ turn.T
    return out


def _travel(start: np.ndarray, low_z: float, tool: YawPose, limits: ActionLimits) -> float:
    """Return the estimated number of actions to the start of a push."""
    (x, y, z), _ = tool
    distance = float(np.abs(start - (x, y)).max())
    return 0.0 if distance <= NEAR_M and z <= low_z else 2.0 + distance / limits.step_m
