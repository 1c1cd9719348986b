"""Top-down grasps."""

from __future__ import annotations

import math
from typing import NamedTuple

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Pose, Vector, downward_pose


class TopDownGrasp(NamedTuple):
    """A pose of a tool that points down, at which its fingers close on a body."""

    body: Body
    position: Vector
    """Of the tool, metres."""
    yaw_rad: float
    clearance_m: float = math.inf
    """Gap between the open fingers and what stands beside them."""
    risk: float = 0.0
    """0 for parallel sides in easy reach; above 1, the grasp is better avoided."""
    cost: float = 0.0
    """Number of actions, expected failures included."""

    @property
    def tool(self) -> Pose:
        """Pose of the tool."""
        return downward_pose(self.position, self.yaw_rad)
