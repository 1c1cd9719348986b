"""Clearance of the whole hand, also of a tilted one, and of fingers from outlines of bodies.

`ba_torchrl.tasks.manipulation.clearance` explains the terms.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache

import numpy as np

from ba_torchrl.sim.bodies import Body, planar_extents, vertical_extent, world_vertices
from ba_torchrl.sim.geometry import PlanarFrame, Pose, downward, rotation_array
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.robots.gripper import Gripper
from ba_torchrl.tasks.manipulation.clearance import SIDE_MARGIN_M, half_gap_m
from ba_torchrl.tasks.manipulation.footprints import Rectangle, extents_m, gaps_m, separation_m


def finger_rectangles(
    gripper: Gripper, tool: PlanarFrame, half_opening_m: float
) -> tuple[Rectangle, Rectangle]:
    """Return the footprints of the two fingers.

    Args:
        half_opening_m: distance between the tool point and the inner side of a finger.
    """
    along = gripper.finger_reach_m - gripper.half_gap_m
    center, half_across = half_opening_m + along / 2, gripper.half_width_m + SIDE_MARGIN_M
    left, right = (
        Rectangle(*tool.to_world(side * center, 0.0), tool.yaw_rad, along / 2, half_across)
        for side in (-1.0, 1.0)
    )
    return left, right


def hand_rectangle(robot: Robot, tool: PlanarFrame) -> Rectangle:
    """Return the footprint of the hand above the height of the palm."""
    return Rectangle(*tool, *robot.hand_half_extents_m)


def knuckles_m(gripper: Gripper) -> tuple[float, float]:
    """Return the reach of the open fingers above the grasp, and the height where it begins."""
    wider = [(u, z) for u, z in gripper.outline if u > gripper.finger_reach_m]
    return max((u for u, _ in wider), default=0.0), min((z for _, z in wider), default=math.inf)


def hand_clearance_m(
    robot: Robot,
    tool: PlanarFrame,
    tool_z_m: float,
    others: Sequence[Body],
) -> float:
    """Return the clearance between the hand above the palm and other bodies.

    Args:
        others: the other bodies; only those higher than the palm count.
    """
    gap = math.inf
    for other in others:
        if vertical_extent(other)[1] > tool_z_m + robot.gripper.palm_height_m:
            axes = zip(planar_extents(other, tool), robot.hand_half_extents_m, strict=True)
            gap = min(gap, max(max(low, -high) - half for (low, high), half in axes))
    return gap


def tool_clearances_m(
    robot: Robot,
    tools: Sequence[Pose],
    others: Iterable[Body],
    opening: float = 1.0,
) -> np.ndarray:
    """Return the clearances between the hand with open fingers at some poses, and other bodies.

    Each is a lower bound, the largest gap between parallel lines that separate the two.

    Args:
        tools: K poses of the tool, which may be tilted.

    Returns:
        [K] metres.
    """
    # in frames at the tools' positions in which the tools point straight down at yaw zero
    upright = np.array(downward(0.0)).T
    to_tools = np.stack([rotation_array(tool.orientation) @ upright for tool in tools])
    origins = np.array([tool.position for tool in tools])[:, None]
    parts, heights = _hand_extents(robot.gripper, robot.hand_half_extents_m, opening)
    gaps = np.full(len(tools), math.inf)
    for other in others:
        corners = (world_vertices(other) - origins) @ to_tools
        separations = separation_m(parts[:, None], extents_m(corners[..., :2]))  # [parts, K]
        is_higher = corners[..., 2].max(axis=1) > heights[:, None]
        gaps = np.minimum(gaps, np.where(is_higher, separations, math.inf).min(axis=0))
    return gaps


@lru_cache(maxsize=64)
def _hand_extents(
    gripper: Gripper, hand_half_extents_m: tuple[float, float], opening: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return outlines and heights of the parts of an open hand at the origin.

    Args:
        hand_half_extents_m: half the extents of the hand above the palm.

    Returns:
        Extremes [parts, 2, BEARINGS] of each part's outline, and its height [parts] above the tool
        point: only bodies that are higher can touch it.
    """
    origin = PlanarFrame(0.0, 0.0, 0.0)
    fingers = finger_rectangles(gripper, origin, half_gap_m(gripper, opening))
    parts = [(finger, gripper.lowest_tip_m) for finger in fingers]
    parts.append((Rectangle(*origin, *hand_half_extents_m), gripper.palm_height_m))
    reach_m, height = knuckles_m(gripper)
    reach_m -= (1 - opening) * gripper.half_gap_m
    parts.append((Rectangle(*origin, reach_m, gripper.half_width_m + SIDE_MARGIN_M), height))
    outlines, heights = zip(*parts, strict=True)
    return np.stack([extents_m(part.corners) for part in outlines]), np.array(heights)


def outline_clearances_m(
    gripper: Gripper,
    tools: Sequence[PlanarFrame],
    half_opening_m: float,
    others: Sequence[Rectangle],
) -> np.ndarray:
    """Return the clearances between the fingers and outlines.

    Args:
        tools: K frames of the tool.
        half_opening_m: distance between the tool point and the inner side of a finger.
        others: outlines of bodies that are higher than the fingertips.

    Returns:
        [K] metres.
    """
    fingers = [f for tool in tools for f in finger_rectangles(gripper, tool, half_opening_m)]
    gaps = gaps_m(fingers, others).reshape(len(tools), 2 * len(others))
    return gaps.min(axis=1, initial=math.inf)
