"""Grasps of boxes on slopes beside a stack."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import (
    Pose,
    Vector,
    axes_quaternion,
    dot,
    perpendicular,
    quaternion_matrix,
)
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.clearance import tool_clearance_m
from ba_torchrl.tasks.structures.parts import CUBOID
from ba_torchrl.tasks.structures.tilted_grasps import is_reachable

ROLL_SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Tilts of the closing axis that are compared: 1 is perpendicular to the sides of the box, so that
the fingers lie flat on them; 0 is horizontal."""
PITCH_SHARES = (1.0, 0.5, 0.0)
"""Approach directions for each of them: 1 is along the normal of the box's top, 0 is as close to
the vertical as the closing axis allows."""


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
    below_centre_m: float,
    offsets_m: Iterable[float],
    opening: float,
    sufficient_m: float,
) -> TiltedGrasp | None:
    """Return the reachable grasp most parallel to a box that has a sufficient clearance.

    If no grasp has a sufficient clearance, the one with the largest is returned.
    """
    frame = Pose(body.position, CUBOID.resting_frame(body))
    closing, _, normal = zip(*quaternion_matrix(frame.orientation), strict=True)
    best: TiltedGrasp | None = None
    for roll in ROLL_SHARES:
        axis = _unit((closing[0], closing[1], roll * closing[2]))
        for offset in offsets_m:
            position = tuple(frame.apply([0.0, offset, -below_centre_m]).tolist())
            for pitch in PITCH_SHARES:
                up = tuple(
                    pitch * n + (1 - pitch) * v
                    for n, v in zip(normal, (0.0, 0.0, 1.0), strict=True)
                )
                down = perpendicular(tuple(-u for u in up), axis)
                tool = Pose(position, axes_quaternion(axis, down))
                clearance_m = tool_clearance_m(robot, tool, others, opening)
                is_better = best is None or clearance_m > best.clearance_m
                if is_better and is_reachable(robot, support_ids, tool):
                    best = TiltedGrasp(tool, clearance_m)
                    if clearance_m >= sufficient_m:
                        return best
    return best


def _unit(vector: Vector) -> Vector:
    """Return a vector normalised."""
    norm = math.sqrt(dot(vector, vector))
    return tuple(v / norm for v in vector)
