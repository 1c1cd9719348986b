"""The fingers of the robot in images: squares seen from above, boxes seen from the side."""

from __future__ import annotations

import math

import numpy as np

from ba_torchrl.sim.geometry import Pose, YawPose, yaw_quaternion
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.vision.depth import PosedShape, SceneMesh
from ba_torchrl.sim.vision.kernels import paint_square

FINGER_SQUARE_HALF_M = 5 * 0.3 / 128
"""Half the edge of the square that represents a finger."""
FINGER_LENGTH_M = 0.1
"""Height of the box that represents a finger in oblique views."""


def finger_boxes(tool: YawPose, offset_m: float) -> SceneMesh:
    """Return the mesh of two boxes that represent the fingers.

    Args:
        tool: position and yaw of the tool, whose height is that of the lower ends of the boxes.
        offset_m: distance between the axis of each box and the tool point.
    """
    (x, y, z), yaw = tool
    box = Box(size_m=(2 * FINGER_SQUARE_HALF_M, 2 * FINGER_SQUARE_HALF_M, FINGER_LENGTH_M))
    return SceneMesh(
        PosedShape(
            box,
            Pose(
                (x + side * math.cos(yaw), y + side * math.sin(yaw), z + FINGER_LENGTH_M / 2),
                yaw_quaternion(yaw),
            ),
        )
        for side in (-offset_m, offset_m)
    )


def draw_fingers(
    image: np.ndarray,
    tool_px: tuple[float, float],
    offset_px: float,
    half_px: float,
    yaw_rad: float,
    value: float,
) -> None:
    """Paint the squares that represent the fingers into an image.

    Args:
        image: [H, W], modified in place.
        tool_px: row and column of the tool point.
        offset_px: distance between each square's centre and the tool point.
        half_px: half the edge of a square.
        yaw_rad: heading of the closing axis, from rows towards columns.
        value: new value of the pixels.
    """
    for side in (-offset_px, offset_px):
        center = (tool_px[0] + side * math.cos(yaw_rad), tool_px[1] + side * math.sin(yaw_rad))
        paint_square(image, center, half_px, yaw_rad, value)
