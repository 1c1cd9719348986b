"""Block Picking: grasp a block and lift it (appendix A.2)."""

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
from ba_torchrl.tasks.manipulation.primitives import grasp, grasped_body, lift
from ba_torchrl.tasks.manipulation.progress_terms import lift_height, reach, staged


@TASKS.register("close_loop/block_picking")
class BlockPicking(CloseLoopTask):
    """Objects: a cubic block of 5 cm.

    Goal: the block is held and the tool is higher than 15 cm. The episode ends early when the block
    leaves the workspace. Paper, appendix A.2.
    """

    scale_limits = (0.6, 1.4)
    fits_tray = True
    lift_height_m: ClassVar[float] = 0.15
    """Least height of the tool at success, metres."""
    goal_vectors = Goal(
        names=("block is grasped", "tool z"),
        achieved=lambda task: (
            task.robot.held_body() is task.block,
            task.robot.tool_pose()[0][2],
        ),
        desired=lambda task: (1.0, task.lift_height_m),
    )

    def load_scene(self) -> None:
        """Load the block."""
        self.block = self.world.add(self.cube(), "block")

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place the block at a random pose, at least 1.2 blocks from the border."""
        xy = self.random_point(rng, 2.4 * self.block_m)
        self.stand(self.block, xy, self.random_yaw(rng, math.pi / 2))

    def evaluate(self) -> dict[str, bool]:
        """Return whether the block is held and whether the tool is higher than 15 cm."""
        return {
            "is_grasped": self.robot.held_body() is self.block,
            "is_lifted": self.robot.tool_pose()[0][2] > self.lift_height_m,
        }

    def instruction(self) -> str:
        """Return the instruction with the block's colour."""
        return f"pick up the {colored(self.block, 'block')}"

    def progress(self) -> float:
        """Return the progress in three stages: reach, grasp, lift."""
        if self.robot.held_body() is self.block:
            low_m = self.settings.workspace.z[0]
            return staged(1.0, 1.0, lift_height(self.robot, low_m, self.lift_height_m))
        yaw = self.block.yaw_rad
        return staged(reach(self.robot, self.block, (yaw, yaw + math.pi / 2)), 0.0, 0.0)

    def expert_command(self) -> GripperCommand:
        """Grasp the block, then lift it."""
        if grasped_body(self.robot) is self.block:
            return lift(self.action_limits.step_m)
        return grasp(self.robot, self.block, self.action_limits)

    @property
    def objects(self) -> Sequence[Body]:
        """The block."""
        return (self.block,)
