"""Camera: the geometry of an observed image, to compute points from its pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.sim.vision.lens import Lens, Range

Values = Literal["depth", "height", "color"]


@dataclass(frozen=True, eq=False)
class Camera:
    """Where a camera is, and which point of the world each of its pixels shows.

    The axes are OpenCV's: x follows the image's columns, y its rows, z the view. The centre
    of the pixel in row i and column j has the image coordinates u = j and v = i.

    Attributes:
        projection: ``perspective`` or ``orthographic``.
        values: of the image: ``depth`` along the view from `pose`, ``height`` above the floor, both
            in metres, or ``color``.
        pixels: rows and columns of the image.
        intrinsics: [3, 3] float64, from camera coordinates to (u, v, 1). Perspective: of
            (x / z, y / z, 1), with focal lengths in pixels. Orthographic: of (x, y, 1) in metres,
            with pixels per metre.
        pose: [4, 4] float64, from camera coordinates to the world, metres.
        near_m: least value of the image; ``color``: near plane.
        far_m: greatest value of the image; ``color``: far plane.
    """

    projection: Literal["perspective", "orthographic"]
    values: Values
    pixels: int
    intrinsics: np.ndarray
    pose: np.ndarray
    near_m: float
    far_m: float

    def points(self, image: np.ndarray) -> np.ndarray:
        """Return the point of the world in each pixel, [H, W, 3] float64 metres.

        Pixels with clipped values, and pixels of drawn fingers in close loop, show no surface.

        Args:
            image: of this camera, or of another one with its pose: [H, W] or [1, H, W], metres.

        Raises:
            ConfigError: the camera has colours, or the shape is another one.
        """
        values = np.asarray(image, dtype=np.float64)
        if self.values == "color":
            raise ConfigError("a camera of colours has no depths; use the camera of 'rgb_depth'")
        shape = (self.pixels, self.pixels)
        if values.shape not in (shape, (1, *shape)):
            raise ConfigError(f"the image must be {[*shape]} or {[1, *shape]}, not {values.shape}")
        rotation, origin = self.pose[:3, :3], self.pose[:3, 3]
        v, u = np.mgrid[: self.pixels, : self.pixels]
        flat = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(self.intrinsics).T
        ray = np.array([0.0, 0.0, 1.0]) if self.projection == "orthographic" else flat
        start = np.zeros(3) if self.projection == "perspective" else flat * (1.0, 1.0, 0.0)
        ray, start = ray @ rotation.T, start @ rotation.T + origin
        along = values.reshape(shape)
        if self.values == "height":
            along = (along - start[..., 2]) / ray[..., 2]
        return start + along[..., None] * ray


def perspective(lens: Lens, pixels: int, range_m: Range, values: Values = "depth") -> Camera:
    """Return the geometry of a perspective image."""
    focal, center = lens.focal_px(pixels), (pixels - 1) / 2
    intrinsics = np.array([[focal, 0.0, center], [0.0, focal, center], [0.0, 0.0, 1.0]])
    down, right, forward = lens.axes
    pose = _pose(np.stack([right, down, forward], axis=1), lens.eye_m)
    return Camera("perspective", values, pixels, intrinsics, pose, *range_m)


def orthographic(
    center_m: tuple[float, float, float],
    side_m: float,
    pixels: int,
    range_m: Range,
    values: Values,
    yaw_rad: float = 0.0,
) -> Camera:
    """Return the geometry of an orthographic image of a square, seen from above.

    Args:
        center_m: position of the camera, of depth 0.
        side_m: edge of the square.
        pixels: rows and columns.
        range_m: of the values.
        values: depths or heights.
        yaw_rad: heading of the rows, 0 is +x.
    """
    scale, center = pixels / side_m, (pixels - 1) / 2
    intrinsics = np.array([[scale, 0.0, center], [0.0, scale, center], [0.0, 0.0, 1.0]])
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    axes = np.array([[-sin, cos, 0.0], [cos, sin, 0.0], [0.0, 0.0, -1.0]]).T
    return Camera("orthographic", values, pixels, intrinsics, _pose(axes, center_m), *range_m)


def _pose(axes: np.ndarray, position: tuple[float, float, float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, position
    return pose
