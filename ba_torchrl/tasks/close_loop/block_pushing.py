"""Block Pushing: push a block to a goal area (appendix A.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from ba_torchrl.core.actions import GripperCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import YawPose
from ba_torchrl.sim.shapes import Decal
from ba_torchrl.tasks.base import BLOCK_M, GREEN, TASKS, CloseLoopTask
from ba_torchrl.tasks.goals import Goal
from ba_torchrl.tasks.instructions import colored
from ba_torchrl.tasks.manipulation.progress_terms import nearness, staged
from ba_torchrl.tasks.manipulation.pushing import Push, reach_behind


@TASKS.register("close_loop/block_pushing")
class BlockPushing(CloseLoopTask):
    """Objects: a cubic block of 5 cm and a square goal area of 9 cm, which images show as a recess
    of 2 cm.

    Goal: the block's centre is within 5 cm of the goal area's centre. The episode ends early
    when the block leaves the workspace. Paper, appendix A.2.
    """

    scale_limits = (0.5, 1.6)
    goal_size_m: ClassVar[float] = 0.09
    """Edge of the goal area, metres."""
    goal_radius_m: ClassVar[float] = 0.05
    """Largest distance between the centres of block and goal area at success, metres."""
    least_distance_m: ClassVar[float] = 0.09
    """Least distance between the centres of block and goal area at the start, metres."""
    goal_vectors = Goal(
        names=("block x", "block y"),
        achieved=lambda task: task.block.position[:2],
        desired=lambda task: task.goal.position[:2],
        radius="goal_radius_m",
        landmarks=(1,),
    )

    def load_scene(self) -> None:
        """Load the block and the goal area."""
        self.block = self.world.add(self.cube(), "block")
        size = (self.goal_size_m, self.goal_size_m, 1e-3)
        self.goal = self.world.add(Decal(size_m=size, color=GREEN, recess_depth_m=0.02), "goal")

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place block and goal area at least 9 cm apart; with fixed orientations, along y."""
        block, goal = self.random_pair(rng, (2.4 * self.block_m, 0.13), self.least_distance_m)
        self.stand(self.block, block, self.random_yaw(rng, math.pi))
        self.stand(self.goal, goal, self.random_yaw(rng, math.pi / 2))

    def evaluate(self) -> dict[str, bool]:
        """Return whether the block is within 5 cm of the goal area."""
        distance_m = math.dist(self.block.position[:2], self.goal.position[:2])
        return {"is_at_goal": distance_m < self.goal_radius_m}

    def instruction(self) -> str:
        """Return the instruction with the colours of block and goal area."""
        return f"push the {colored(self.block, 'block')} onto the {colored(self.goal, 'square')}"

    def progress(self) -> float:
        """Return the progress in two stages: reach behind the block, and block to the goal area."""
        goal = self.goal.position[:2]
        return staged(
            reach_behind(self.robot, self.block, goal, self.settings.workspace),
            nearness(math.dist(self.block.position[:2], goal) - self.goal_radius_m),
        )

    def expert_command(self) -> GripperCommand:
        """Move behind the block and push it with half-open fingers.

        The gap between them decreases with the size of the block, so that it never fits in between.
        """
        return Push(
            self.robot,
            self.block,
            self.goal.position[:2],
            workspace=self.settings.workspace,
            limits=self.action_limits,
            opening=0.5 - max(BLOCK_M - self.block_m, 0.0) / (2 * self.robot.gripper.half_gap_m),
            stop_short_m=0.035,
        ).command()

    @property
    def landmarks(self) -> Sequence[YawPose]:
        """Poses of block and goal area."""
        return [(body.position, body.yaw_rad) for body in (self.block, self.goal)]

    @property
    def objects(self) -> Sequence[Body]:
        """The block; the goal area is a marking on the floor."""
        return (self.block,)
