"""A close-loop task: lift a tall block, and hold it over a corner of the workspace."""

import math

from ba_torchrl.core.config import TaskParameters
from ba_torchrl.sim.shapes import Box
from ba_torchrl.tasks.base import TASKS, CloseLoopTask
from ba_torchrl.tasks.manipulation.primitives import CLOSED, grasp, move_toward


@TASKS.register("mine/tall_block")
class TallBlock(CloseLoopTask):
    """A block of 4 x 4 x 7 cm; success when it is held over the corner, 12 cm above the ground."""

    class Parameters(TaskParameters):
        """Parameters of this task alone."""

        tolerance_m: float = 0.03
        """Distance from the corner that still counts."""

    lift_height_m = 0.12

    def load_scene(self):
        """Load the block."""
        size = tuple(edge * self.settings.scale for edge in (0.04, 0.04, 0.07))
        self.block = self.world.add(Box(size_m=size), "tall block")

    def initialize_episode(self, rng):
        """Put the block anywhere."""
        self.stand(self.block, self.random_point(rng, 0.12), self.random_yaw(rng, math.pi / 2))

    @property
    def objects(self):
        """The block."""
        return (self.block,)

    @property
    def goal(self):
        """The place over the corner."""
        workspace = self.settings.workspace
        return workspace.x[0] + 0.04, workspace.y[0] + 0.04, 0.15

    def evaluate(self):
        """Return whether the block is held, high enough, and over the corner."""
        (x, y, z), _ = self.robot.tool_pose()
        distance_m = math.dist((x, y), self.goal[:2])
        return {
            "is_grasped": self.robot.held_body() is self.block,
            "is_lifted": z > self.lift_height_m,
            "is_over_corner": distance_m < self.settings.parameters.tolerance_m,
        }

    def instruction(self):
        """Return the goal as a sentence."""
        return "hold the red block over the corner"

    def expert_command(self):
        """Grasp the block, then carry it to its place."""
        if self.robot.held_body() is not self.block or self.robot.opening() >= 0.9:
            return grasp(self.robot, self.block, self.action_limits)
        return move_toward(self.robot, self.goal, self.robot.tool_pose()[1], CLOSED)
