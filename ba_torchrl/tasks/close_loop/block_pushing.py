"""Block Pushing: push a block to a goal area (appendix A.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from ba_torchrl.actions import GripperCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import YawPose
from ba_torchrl.sim.shapes import Decal
from ba_torchrl.tasks.base import BLOCK_M, TASKS
from ba_torchrl.tasks.close_loop_task import GREEN, CloseLoopTask
from ba_torchrl.tasks.motion_primitives import push


@TASKS.register("close_loop/block_pushing")
class BlockPushing(CloseLoopTask):
    """A 5 cm block and a 9 cm goal area; success when their centres are within 5 cm.

    The depth image shows the goal area as a dip of 2 cm in the floor.
    """

    scale_limits = (0.5, 1.6)
    goal_size_m: ClassVar[float] = 0.09
    goal_radius_m: ClassVar[float] = 0.05
    least_distance_m: ClassVar[float] = 0.09

    def load_scene(self) -> None:
        """Load the block and the goal area."""
        self.block = self.world.add(self.cube(), "block")
        size = (self.goal_size_m, self.goal_size_m, 1e-3)
        self.goal = self.world.add(Decal(size_m=size, color=GREEN, recess_depth_m=0.02), "goal")

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Put block and goal at least 9 cm apart; with fixed orientations, along y."""
        block, goal = self.random_pair(rng, (2.4 * self.block_m, 0.13), self.least_distance_m)
        self.stand(self.block, block, self.random_yaw(rng, math.pi))
        self.stand(self.goal, goal, self.random_yaw(rng, math.pi / 2))

    def evaluate(self) -> dict[str, bool]:
        """Return whether the block's centre is within 5 cm of the goal's."""
        distance_m = math.dist(self.block.position[:2], self.goal.position[:2])
        return {"is_at_goal": distance_m < self.goal_radius_m}

    def expert_command(self) -> GripperCommand:
        """Go behind the block and push it with half-open fingers.

        They are as much nearer to each other as it is smaller, or they would straddle it.
        """
        return push(
            self.robot,
            self.block,
            self.goal.position[:2],
            workspace=self.settings.workspace,
            limits=self.action_limits,
            opening=0.5 - max(BLOCK_M - self.block_m, 0.0) / (2 * self.robot.gripper.half_gap_m),
            stop_short_m=0.035,
        )

    @property
    def landmarks(self) -> Sequence[YawPose]:
        """Block and goal."""
        return [(body.position, body.yaw_rad) for body in (self.block, self.goal)]

    @property
    def objects(self) -> Sequence[Body]:
        """The block; the goal is painted on the floor."""
        return (self.block,)
