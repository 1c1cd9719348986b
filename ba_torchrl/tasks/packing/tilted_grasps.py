"""Grasps of boxes that lie on slopes beside a stack."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import (
    Pose,
    axes_quaternion,
    dot,
    perpendicular,
    quaternion_matrix,
)
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.manipulation.hand_clearance import tool_clearances_m
from ba_torchrl.tasks.manipulation.top_down_grasps import is_reachable
from ba_torchrl.tasks.packing.base import SUFFICIENT_CLEARANCE_M
from ba_torchrl.tasks.structures.pieces import CUBOID
from ba_torchrl.tasks.structures.tilts import resting_frame

ROLL_SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Tilts of the closing axis that are compared: 1 is perpendicular to the sides of the box, so that
the fingers lie flat on them; 0 is horizontal."""
PITCH_SHARES = (1.0, 0.5, 0.0, -0.5, -1.0)
"""Approach directions for each of them: 1 is along the normal of the box's top, 0 is as close to
the vertical as the closing axis allows, and -1 is inclined to the other side."""
ROLL_COST_M = 0.03
"""Clearance that a grasp gains to be preferred to one that is more parallel to the sides of the
box by one radian. Fingers on its edges rotate it, or lose it."""
PITCH_COST_M = 0.003
"""The same for the approach direction. The place corrects it."""
OFFSET_COST = 0.2
"""The same for a grasp closer to the centre of the box, as a multiple of the distance."""


class TiltedGrasp(NamedTuple):
    """A pose of the tool at which the fingers close on a tilted box."""

    tool: Pose
    clearance_m: float
    """Clearance between the open hand on its approach and other bodies."""


def tilted_grasp(
    robot: Robot,
    support_ids: frozenset[int],
    body: Body,
    others: Sequence[Body],
    *,
    above_centre_m: float,
    offsets_m: Iterable[float],
    opening: float,
) -> TiltedGrasp | None:
    """Return the best reachable grasp of a box: most parallel to it, central and with clearance.

    Args:
        support_ids: PyBullet ids of the bodies that form the ground.
        body: the box, longest along y.
        above_centre_m: height of the tool above the centre of the box, along the normal of its top.
        offsets_m: distances of the grasps from the centre along the box.

    Returns:
        The grasp; None if none is within reach.
    """
    frame = Pose(body.position, resting_frame(CUBOID, body))
    closing, _, normal = zip(*quaternion_matrix(frame.orientation), strict=True)
    roll_rad, tilt_rad = abs(math.asin(closing[2])), math.acos(min(normal[2], 1.0))
    candidates = sorted(
        (
            (1 - roll) * roll_rad * ROLL_COST_M
            + (1 - pitch) * tilt_rad * PITCH_COST_M
            + abs(offset) * OFFSET_COST,
            -roll,
            -pitch,
            offset,
        )
        for roll, pitch, offset in itertools.product(ROLL_SHARES, PITCH_SHARES, offsets_m)
    )
    best, best_score = None, -math.inf
    for cost, roll, pitch, offset in candidates:
        if SUFFICIENT_CLEARANCE_M - cost <= best_score:
            break
        axis = (closing[0], closing[1], -roll * closing[2])
        norm = math.sqrt(dot(axis, axis))
        axis = tuple(a / norm for a in axis)
        up = (-pitch * normal[0], -pitch * normal[1], 1 + pitch - pitch * normal[2])
        down = perpendicular(tuple(-u for u in up), axis)
        position = tuple(frame.apply(np.array([0.0, offset, above_centre_m])).tolist())
        tool = Pose(position, axes_quaternion(axis, down))
        (clearance_m,) = tool_clearances_m(robot, [tool], others, opening).tolist()
        score = min(clearance_m, SUFFICIENT_CLEARANCE_M) - cost
        if score > best_score and is_reachable(robot, support_ids, tool):
            best, best_score = TiltedGrasp(tool, clearance_m), score
    return best
