"""Top-down grasps, and which poses of the tool the arm reaches."""

from __future__ import annotations

import math
from typing import NamedTuple

from ba_torchrl.core.actions import MAX_TILT_RAD
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.control.pick_place import PickPlaceLimits, approach_point, plan_approach
from ba_torchrl.sim.geometry import (
    Pose,
    Vector,
    downward_pose,
    quaternion_matrix,
    tool_angles,
)
from ba_torchrl.sim.robots.base import Robot


class TopDownGrasp(NamedTuple):
    """A pose of the tool, pointing down, at which the fingers close on a body."""

    body: Body
    position: Vector
    """Position of the tool, metres."""
    yaw_rad: float
    clearance_m: float = math.inf
    """Clearance between the open fingers and other bodies."""
    risk: float = 0.0
    """Risk of failure as a score: 0 is best, above 1 the grasp is avoided."""
    cost: float = 0.0
    """Expected number of actions, with those after failures."""

    @property
    def tool(self) -> Pose:
        """Pose of the tool."""
        return downward_pose(self.position, self.yaw_rad)


def is_reachable(
    robot: Robot, support_ids: frozenset[int], tool: Pose, clearance_m: float = 0.0
) -> bool:
    """Whether the arm reaches a pose of the tool and the approach to it.

    Both are also reached after half a turn of the tool, which the action space may add.

    Args:
        support_ids: PyBullet ids of the bodies that form the ground.
        clearance_m: distance before the pose at which the approach ends.
    """
    if any(abs(tilt) > MAX_TILT_RAD for tilt in tool_angles(tool.orientation)[1:]):
        return False
    rotation = quaternion_matrix(tool.orientation)
    end = approach_point(tool.position, rotation, clearance_m)
    half_turn = tuple((-x, -y, z) for x, y, z in rotation)
    return all(
        plan_approach(robot, support_ids, PickPlaceLimits(), end, turned) is not None
        for turned in (rotation, half_turn)
    )
