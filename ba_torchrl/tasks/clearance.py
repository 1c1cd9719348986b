"""Clearance: how much room a gripper needs, from its measured outline.

Clearances are gaps in metres, negative where something is in the way and infinite where nothing is
near. Distances along x are along the line on which the fingers close. Other bodies are in the
fingers' way if they reach higher than the fingertips.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from ba_torchrl.sim.bodies import Body, world_vertices
from ba_torchrl.sim.geometry import PlanarFrame, Vector
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.robots.gripper import Gripper
from ba_torchrl.tasks.footprints import Rectangle, gap_m

Range = tuple[float, float]
"""Ends of an interval along the line on which the fingers close."""

INSIDE_M = 3e-3
"""Margin between open fingers and the gap that they leave."""
OUTSIDE_M = 7.5e-3
"""Margin beyond the outside of the fingers on their way down."""
ASIDE_M = 2.5e-3
"""Margin on both sides of a finger that stands between neighbours."""
OVER_M = 0.03
"""Height of the tool above what it passes over; more for fingers that end deeper."""
UNDER_TIPS_M = 0.012
"""Gap below fingertips that pass over something, at least."""


# -- parts of a gripper ------------------------------------------------------------------------


def half_gap_m(gripper: Gripper, opening: float = 1.0) -> float:
    """Return the distance from the tool point that is surely between the open fingers.

    Args:
        gripper: the gripper.
        opening: 0 to 1.
    """
    return opening * (gripper.half_gap_m - INSIDE_M)


def reach_m(gripper: Gripper, opening: float = 1.0) -> float:
    """Return how far the fingers reach from the tool point, with a margin.

    Args:
        gripper: the gripper.
        opening: 0 to 1.
    """
    return gripper.finger_reach_m - (1 - opening) * gripper.half_gap_m + OUTSIDE_M


def finger_ranges_m(gripper: Gripper, opening: float = 1.0) -> tuple[Range, Range]:
    """Return the ranges that the two fingers take up, from the tool point."""
    inner, outer = half_gap_m(gripper, opening), reach_m(gripper, opening)
    return (-outer, -inner), (inner, outer)


def finger_rectangles(
    gripper: Gripper, tool: PlanarFrame, half_opening_m: float
) -> tuple[Rectangle, Rectangle]:
    """Return the two fingers as seen from above.

    Args:
        gripper: the gripper.
        tool: frame of the tool.
        half_opening_m: from the tool point to a finger's inner side.
    """
    along = gripper.finger_reach_m - gripper.half_gap_m
    middle, half_across = half_opening_m + along / 2, gripper.half_width_m + ASIDE_M
    left, right = (
        Rectangle(*tool.to_world(side * middle, 0.0), tool.yaw_rad, along / 2, half_across)
        for side in (-1.0, 1.0)
    )
    return left, right


def hand_rectangle(robot: Robot, tool: PlanarFrame) -> Rectangle:
    """Return the whole hand as seen from above; it begins at the height of the palm."""
    return Rectangle(*tool, *robot.hand_half_extents_m)


def tips_below_tool_m(robot: Robot) -> float:
    """Return how far below the tool point the fingers end as they are opened now."""
    return -robot.gripper.tip_height_m(robot.opening() * robot.gripper.half_gap_m)


def passing_height_m(gripper: Gripper) -> float:
    """Return the height of the tool above a body at which the fingertips pass over it."""
    return max(OVER_M, UNDER_TIPS_M - gripper.lowest_tip_m)


# -- clearances --------------------------------------------------------------------------------


def path_clearance_m(
    gripper: Gripper,
    body: Body,
    yaw_rad: float,
    ranges_m: Sequence[Range],
    others: Sequence[Body],
    at: Vector | None = None,
) -> float:
    """Return the gap between fingertips on their way down beside a body, and other bodies.

    Args:
        gripper: the gripper.
        body: what the fingers are to close on.
        yaw_rad: of the gripper.
        ranges_m: what the fingers take up, from the body's origin.
        others: bodies that may be in the way.
        at: position of the body, if not where it is now.
    """
    bx, by, bz = body.position if at is None else at
    frame = PlanarFrame(bx, by, yaw_rad)
    gap = math.inf
    for other in others:
        corners = world_vertices(other)
        if corners[:, 2].max() < bz + gripper.lowest_tip_m:
            continue
        along, across = frame.to_local(corners[:, 0], corners[:, 1])
        aside = max(across.min(), -across.max()) - gripper.half_width_m
        for low, high in ranges_m:
            gap = min(gap, max(along.min() - high, low - along.max(), aside))
    return float(gap)


def grasp_clearance_m(
    gripper: Gripper,
    body: Body,
    yaw_rad: float,
    others: Sequence[Body],
    opening: float = 1.0,
    at: Vector | None = None,
) -> float:
    """Return the gap between the fingers, open around the middle of a body, and other bodies.

    Args:
        gripper: the gripper.
        body: what the fingers are to close on.
        yaw_rad: of the gripper.
        others: bodies that may be in the way.
        opening: of the gripper, 0 to 1.
        at: position of the body, if not where it is now.
    """
    ranges = finger_ranges_m(gripper, opening)
    return path_clearance_m(gripper, body, yaw_rad, ranges, others, at)


def hand_clearance_m(
    robot: Robot, tool: PlanarFrame, tool_z_m: float, others: Sequence[Body]
) -> float:
    """Return the gap between the hand above the fingers and other bodies.

    Args:
        robot: the robot.
        tool: frame of the tool.
        tool_z_m: height of the tool.
        others: bodies that may be in the way if they reach up to the palm.
    """
    gap = math.inf
    for other in others:
        corners = world_vertices(other)
        if corners[:, 2].max() > tool_z_m + robot.gripper.palm_height_m:
            local = np.stack(tool.to_local(corners[:, 0], corners[:, 1]), axis=1)
            gaps = np.maximum(local.min(axis=0), -local.max(axis=0)) - robot.hand_half_extents_m
            gap = min(gap, float(gaps.max()))
    return gap


def outline_clearance_m(
    gripper: Gripper, tool: PlanarFrame, half_opening_m: float, others: Iterable[Rectangle]
) -> float:
    """Return the gap between the fingers and the outlines of what stands beside them.

    Args:
        gripper: the gripper.
        tool: frame of the tool.
        half_opening_m: from the tool point to a finger's inner side.
        others: outlines of what is higher than the fingertips.
    """
    fingers = finger_rectangles(gripper, tool, half_opening_m)
    return min((gap_m(finger, other) for other in others for finger in fingers), default=math.inf)
