"""The camera pose at which given points fill a colour image."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pybullet

from ba_torchrl.sim.geometry import Vector


class Viewpoint(NamedTuple):
    """A camera pose that looks at a target."""

    target_m: Vector
    """Point at the centre of the image."""
    distance_m: float
    """From the target to the camera."""
    yaw_deg: float
    pitch_deg: float
    """Negative angles look down."""

    def view_matrix(self) -> tuple[float, ...]:
        """Return PyBullet's view matrix."""
        return pybullet.computeViewMatrixFromYawPitchRoll(*self, 0.0, 2)


def fit_viewpoint(
    points_m: np.ndarray,
    yaw_deg: float,
    pitch_deg: float,
    fov_deg: float,
    aspect: float,
    margin: float = 0.0,
) -> Viewpoint:
    """Return the nearest camera pose at which an image of a perspective camera shows all points.

    Where the image is wider than the points, they are near its centre. Where it is higher, the
    lowest point is at the lower margin, which leaves space for the arm above.

    Args:
        points_m: [N, 3] metres.
        yaw_deg: yaw of the camera.
        pitch_deg: pitch of the camera.
        fov_deg: vertical field of view.
        aspect: width of the image divided by its height.
        margin: width of the empty border, as a fraction of the width and height of the image.
    """
    view = Viewpoint((0.0, 0.0, 0.0), 1.0, yaw_deg, pitch_deg).view_matrix()
    axes = np.reshape(view, (4, 4)).T[:3, :3]  # rows: right, up, backward
    right, up, backward = axes @ np.asarray(points_m, dtype=float).T
    half_height = (1 - 2 * margin) * math.tan(math.radians(fov_deg) / 2)
    half_width = half_height * aspect
    # In camera axes with the camera at c, the right edge requires
    # right - c_right <= half_width * (c_backward - backward); the other edges are similar.
    to_right = (right + half_width * backward).max()
    to_left = (half_width * backward - right).max()
    to_top = (up + half_height * backward).max()
    to_bottom = (half_height * backward - up).max()
    c_backward = max(
        (to_right + to_left) / (2 * half_width), (to_top + to_bottom) / (2 * half_height)
    )
    camera = np.array([(to_right - to_left) / 2, half_height * c_backward - to_bottom, c_backward])
    distance = float(c_backward - (backward.min() + backward.max()) / 2)
    target = (camera - (0.0, 0.0, distance)) @ axes
    return Viewpoint(tuple(target.tolist()), distance, yaw_deg, pitch_deg)
