"""Perspective cameras: where they are and how points project into their images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ba_torchrl.sim.geometry import Vector

Range = tuple[float, float]

NEAR_M = 0.01
FAR_M = 10.0
"""Perspective cameras see nothing nearer and nothing farther."""


@dataclass(frozen=True)
class Lens:
    """A square perspective camera that looks from one point at another.

    Args:
        eye_m: where it is.
        target_m: what it shows in the middle.
        fov_rad: angle between opposite edges of the image.
    """

    eye_m: Vector
    target_m: Vector
    fov_rad: float

    @cached_property
    def axes(self) -> np.ndarray:
        """[3, 3]: directions of the rows, of the columns, and of the view."""
        forward = np.subtract(self.target_m, self.eye_m)
        forward = forward / np.linalg.norm(forward)
        # rows follow +x, or lead down if that is where the camera looks
        hint = np.array([1.0, 0.0, 0.0] if abs(forward[0]) < 0.99 else [0.0, 0.0, -1.0])
        down = hint - (hint @ forward) * forward
        down /= np.linalg.norm(down)
        return np.stack([down, np.cross(down, forward), forward])

    def focal_px(self, pixels: int) -> float:
        """Return the focal length in pixels of an image of this size."""
        return pixels / 2 / math.tan(self.fov_rad / 2)

    def heights_m(self, depth: np.ndarray) -> np.ndarray:
        """Return the height above the floor of what an image [N, N] of depths shows."""
        pixels = len(depth)
        offsets = (np.arange(pixels) + 0.5 - pixels / 2) / self.focal_px(pixels)
        fall = self.axes[2, 2] + offsets[:, None] * self.axes[0, 2] + offsets * self.axes[1, 2]
        return self.eye_m[2] + depth * fall

    def plane_depth_range_m(self, z_m: float) -> Range:
        """Return the least and greatest depth at which the image shows a horizontal plane.

        Args:
            z_m: height of the plane.
        """
        edge = math.tan(self.fov_rad / 2)
        falls = [
            -(self.axes[2, 2] + p * self.axes[0, 2] + q * self.axes[1, 2])
            for p in (-edge, edge)
            for q in (-edge, edge)
        ]
        above = self.eye_m[2] - z_m
        low = above / max(falls) if max(falls) > 0 else FAR_M
        high = above / min(falls) if min(falls) > 0 else FAR_M
        return max(low, NEAR_M), min(max(high, NEAR_M), FAR_M)


def oblique_lens(center_m: tuple[float, float]) -> Lens:
    """Return the camera opposite the robot, 0.81 m from the workspace's centre, 47 degrees up."""
    x, y = center_m
    return Lens((x + 0.55, y, 0.6), (x, y, 0.0), math.radians(40))


def side_lenses(center_m: tuple[float, float], width_m: float) -> tuple[Lens, Lens]:
    """Return two cameras on either side, 0.5 m along y and 1 m up, that show a square of the floor.

    Args:
        center_m: middle of the square.
        width_m: its edge.
    """
    x, y = center_m
    # the corners of the near edge are the widest apart
    below, aside = 1.0, 0.5 - width_m / 2
    distance = (below + 0.5 * aside) / math.hypot(1.0, 0.5)
    across = abs(aside - 0.5 * below) / math.hypot(1.0, 0.5)
    edge = max(width_m / 2, across) / max(distance, 0.1)
    fov = 2 * math.atan(edge * 1.02)
    return tuple(Lens((x, y + side, 1.0), (x, y, 0.0), fov) for side in (-0.5, 0.5))
