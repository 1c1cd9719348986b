"""Clearance of the fingers of a gripper that points straight down, from its measured outline.

Clearances are gaps in metres: negative in collision, infinite if no body is near. The x axis is the
direction in which the fingers close. Only bodies higher than the fingertips count. Openings of the
gripper are from 0, closed, to 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ba_torchrl.sim.bodies import Body, planar_extents, vertical_extent
from ba_torchrl.sim.geometry import PlanarFrame, Vector
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.robots.gripper import Gripper

Range = tuple[float, float]
"""Ends of an interval along the direction in which the fingers close."""

INNER_MARGIN_M = 3e-3
"""Margin on the inner side of each finger."""
OUTER_MARGIN_M = 7.5e-3
"""Margin on the outer side of each descending finger."""
SIDE_MARGIN_M = 2.5e-3
"""Margin on both flanks of a finger."""
PASSING_HEIGHT_M = 0.03
"""Height of the tool above bodies that it passes over; more for grippers with longer fingers."""
PASSING_GAP_M = 0.012
"""Least gap between the fingertips and bodies that they pass over."""


# -- parts of a gripper ------------------------------------------------------------------------


def half_gap_m(gripper: Gripper, opening: float = 1.0) -> float:
    """Return half the width of the gap between the fingers, less a margin."""
    return opening * (gripper.half_gap_m - INNER_MARGIN_M)


def finger_extent_m(gripper: Gripper, opening: float = 1.0) -> float:
    """Return the distance of the fingers' outer sides from the tool point, plus a margin."""
    return gripper.finger_reach_m - (1 - opening) * gripper.half_gap_m + OUTER_MARGIN_M


def finger_ranges_m(gripper: Gripper, opening: float = 1.0) -> tuple[Range, Range]:
    """Return the ranges that the two fingers occupy, relative to the tool point."""
    inner, outer = half_gap_m(gripper, opening), finger_extent_m(gripper, opening)
    return (-outer, -inner), (inner, outer)


def tips_below_tool_m(robot: Robot) -> float:
    """Return the distance of the fingertips below the tool point at the present opening."""
    return -robot.gripper.tip_height_m(robot.opening() * robot.gripper.half_gap_m)


def passing_height_m(gripper: Gripper) -> float:
    """Return the height of the tool above a body that the gripper passes over."""
    return max(PASSING_HEIGHT_M, PASSING_GAP_M - gripper.lowest_tip_m)


# -- clearances --------------------------------------------------------------------------------


def path_clearance_m(
    gripper: Gripper,
    body: Body,
    yaw_rad: float,
    ranges_m: Sequence[Range],
    others: Sequence[Body],
    at: Vector | None = None,
) -> float:
    """Return the clearance between the fingertips on their path to a body, and other bodies.

    Args:
        ranges_m: ranges that the fingers occupy, relative to the origin of the body.
        at: assumed position of the body; its present one if None.
    """
    bx, by, bz = body.position if at is None else at
    frame = PlanarFrame(bx, by, yaw_rad)
    gap = math.inf
    for other in others:
        if vertical_extent(other)[1] < bz + gripper.lowest_tip_m:
            continue
        (nearest, farthest), (left, right) = planar_extents(other, frame)
        gap_across = max(left, -right) - gripper.half_width_m
        for low, high in ranges_m:
            gap = min(gap, max(nearest - high, low - farthest, gap_across))
    return gap


def grasp_clearance_m(
    gripper: Gripper,
    body: Body,
    yaw_rad: float,
    others: Sequence[Body],
    opening: float = 1.0,
    at: Vector | None = None,
) -> float:
    """Return the clearance between the fingers, opened around a body's origin, and other bodies.

    Args:
        at: assumed position of the body; its present one if None.
    """
    ranges = finger_ranges_m(gripper, opening)
    return path_clearance_m(gripper, body, yaw_rad, ranges, others, at)
