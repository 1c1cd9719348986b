"""Top-down grasps."""

from __future__ import annotations

import math
from typing import NamedTuple

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Pose, Vector, downward_pose


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
