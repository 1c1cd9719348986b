"""Block Reaching: bring the fingertips to a block (appendix A.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from ba_torchrl.core.actions import GripperCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.tasks.base import TASKS, CloseLoopTask
from ba_torchrl.tasks.goals import Goal
from ba_torchrl.tasks.instructions import colored
from ba_torchrl.tasks.manipulation.primitives import OPEN, grasp
from ba_torchrl.tasks.manipulation.progress_terms import reach, staged


@TASKS.register("close_loop/block_reaching")
class BlockReaching(CloseLoopTask):
    """Objects: a cubic block of 5 cm.

    Goal: the tool point is within 3 cm of the centre of the block. The episode ends early when the
    block leaves the workspace. Paper, appendix A.2.
    """

    scale_limits = (0.5, 1.6)
    fits_tray = True
    goal_distance_m: ClassVar[float] = 0.03
    """Largest distance between tool point and centre of the block at success, metres."""
    goal_vectors = Goal(
        names=("tool x", "tool y", "tool z"),
        achieved=lambda task: task.robot.tool_pose()[0],
        desired=lambda task: task.block.position,
        radius="goal_distance_m",
        landmarks=(0,),
    )

    def load_scene(self) -> None:
        """Load the block."""
        self.block = self.world.add(self.cube(), "block")

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place the block at a random pose, at least 1.2 blocks from the border."""
        xy = self.random_point(rng, 2.4 * self.block_m)
        self.stand(self.block, xy, self.random_yaw(rng, math.pi))

    def evaluate(self) -> dict[str, bool]:
        """Return whether the tool point is within 3 cm of the block's centre."""
        distance_m = math.dist(self.robot.tool_pose()[0], self.block.position)
        return {"is_reached": distance_m < self.goal_distance_m}

    def instruction(self) -> str:
        """Return the instruction with the block's colour."""
        return f"move the gripper to the {colored(self.block, 'block')}"

    def progress(self) -> float:
        """Return the nearness of the tool point, with open fingers, to the region of success."""
        yaws = (self.block.yaw_rad, self.block.yaw_rad + math.pi / 2)
        return staged(reach(self.robot, self.block, yaws, self.goal_distance_m))

    def expert_command(self) -> GripperCommand:
        """Descend around the block with open fingers."""
        return grasp(self.robot, self.block, self.action_limits)._replace(opening=OPEN)

    @property
    def objects(self) -> Sequence[Body]:
        """The block."""
        return (self.block,)
