"""Lens: pose and intrinsics of a perspective camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ba_torchrl.sim.geometry import Pose, Vector

Range = tuple[float, float]

NEAR_M = 0.01
"""Near plane of perspective cameras."""
FAR_M = 10.0
"""Far plane of perspective cameras."""

WRIST_EYE_M = (0.0, -0.095, -0.125)
"""Position of the wrist camera in the tool frame."""
WRIST_FOV_RAD = math.radians(65)
"""Field of view of the wrist camera."""


@dataclass(frozen=True)
class Lens:
    """Pose and field of view of a perspective camera with square images.

    The field of view is between opposite edges of the image. Image rows follow ``down``, as far as
    it is perpendicular to the view; by default +x, or -z if the camera looks along x.
    """

    eye_m: Vector
    target_m: Vector
    fov_rad: float
    down: Vector | None = None

    @cached_property
    def axes(self) -> np.ndarray:
        """Directions of the image rows, of the image columns and of the view, [3, 3] as rows."""
        forward = np.subtract(self.target_m, self.eye_m)
        forward = forward / np.linalg.norm(forward)
        default = [1.0, 0.0, 0.0] if abs(forward[0]) < 0.99 else [0.0, 0.0, -1.0]
        hint = np.array(default if self.down is None else self.down)
        down = hint - (hint @ forward) * forward
        down /= np.linalg.norm(down)
        return np.stack([down, np.cross(down, forward), forward])

    def focal_px(self, pixels: int) -> float:
        """Return the focal length in pixels."""
        return pixels / 2 / math.tan(self.fov_rad / 2)

    def heights_m(self, depth: np.ndarray) -> np.ndarray:
        """Convert a depth image [N, N] to heights above the floor, metres."""
        pixels = len(depth)
        offsets = (np.arange(pixels) + 0.5 - pixels / 2) / self.focal_px(pixels)
        slope = self.axes[2, 2] + offsets[:, None] * self.axes[0, 2] + offsets * self.axes[1, 2]
        return self.eye_m[2] + depth * slope

    def plane_depth_range_m(self, z_m: float) -> Range:
        """Return the least and greatest depth of a horizontal plane in the image."""
        edge = math.tan(self.fov_rad / 2)
        descents = [
            -(self.axes[2, 2] + p * self.axes[0, 2] + q * self.axes[1, 2])
            for p in (-edge, edge)
            for q in (-edge, edge)
        ]
        above = self.eye_m[2] - z_m
        low = above / max(descents) if max(descents) > 0 else FAR_M
        high = above / min(descents) if min(descents) > 0 else FAR_M
        return max(low, NEAR_M), min(max(high, NEAR_M), FAR_M)


def oblique_lens(center_m: tuple[float, float]) -> Lens:
    """Return the camera opposite the robot, 0.81 m from the workspace centre at 47 degrees."""
    x, y = center_m
    return Lens((x + 0.55, y, 0.6), (x, y, 0.0), math.radians(40))


def wrist_lens(tool: Pose) -> Lens:
    """Return a camera on the gripper that looks along the fingers at the point between their tips.

    It is beside the hand, in the plane between the fingers; image columns follow the closing axis.
    """
    eye = tool.compose(Pose(WRIST_EYE_M)).position
    down = tool.compose(Pose((0.0, 1.0, 0.0))).position
    return Lens(eye, tool.position, WRIST_FOV_RAD, tuple(np.subtract(down, tool.position)))


def side_lenses(center_m: tuple[float, float], width_m: float) -> tuple[Lens, Lens]:
    """Return two cameras at y offsets of -0.5 and 0.5 m, 1 m high, that show a square."""
    x, y = center_m
    # the corners of the edge closest to the camera determine the field of view
    below, lateral = 1.0, 0.5 - width_m / 2
    distance = (below + 0.5 * lateral) / math.hypot(1.0, 0.5)
    across = abs(lateral - 0.5 * below) / math.hypot(1.0, 0.5)
    edge = max(width_m / 2, across) / max(distance, 0.1)
    fov = 2 * math.atan(edge * 1.02)
    return tuple(Lens((x, y + side, 1.0), (x, y, 0.0), fov) for side in (-0.5, 0.5))
