"""A close-loop task: hold the red block over the blue plate."""

import math

from ba_torchrl.core.config import TaskParameters
from ba_torchrl.sim.shapes import Box
from ba_torchrl.tasks.base import BLUE, RED, TASKS, CloseLoopTask
from ba_torchrl.tasks.instructions import colored
from ba_torchrl.tasks.manipulation.primitives import CLOSED, grasp, grasped_body, move_toward
from ba_torchrl.tasks.manipulation.progress_terms import nearness, reach, share, staged


@TASKS.register("mine/my_task")
class MyTask(CloseLoopTask):
    """A block of 5 cm and a plate of 8 x 8 x 2 cm; success when the block is held over it."""

    class Parameters(TaskParameters):
        """Parameters of this task alone, keywords of `ba_torchrl.make`."""

        tolerance_m: float = 0.03
        """Horizontal distance between block and plate that still counts."""

    height_m = 0.1
    """Least height of the tool at success."""

    def load_scene(self):
        """Load block and plate; a shape's size is the product of its own and the task's scale."""
        scale = self.settings.scale
        self.block = self.world.add(self.cube(RED), "block")
        plate = Box(size_m=(0.08 * scale, 0.08 * scale, 0.02 * scale), color=BLUE)
        self.plate = self.world.add(plate, "plate")

    def initialize_episode(self, rng):
        """Place both at random poses, at least 12 cm apart and 6 cm from the border."""
        points = self.random_pair(rng, (0.12, 0.12), 0.12)
        for body, xy in zip(self.objects, points, strict=True):
            self.stand(body, xy, self.random_yaw(rng, math.pi / 2))

    @property
    def objects(self):
        """Block and plate, which must stay in the workspace."""
        return self.block, self.plate

    def instruction(self):
        """Return the goal with the colours of the objects."""
        block, plate = colored(self.block, "block"), colored(self.plate, "plate")
        return f"hold the {block} over the {plate}"

    def distance_m(self):
        """Return the horizontal distance between block and plate."""
        return math.dist(self.block.position[:2], self.plate.position[:2])

    def evaluate(self):
        """Return the conditions that all hold at success."""
        return {
            "is_grasped": self.robot.held_body() is self.block,
            "is_lifted": self.robot.tool_pose()[0][2] > self.height_m,
            "is_over_plate": self.distance_m() < self.settings.parameters.tolerance_m,
        }

    def progress(self):
        """Return the progress in four stages: reach, grasp, lift, move over the plate."""
        if self.robot.held_body() is not self.block:
            yaw = self.block.yaw_rad
            yaws = yaw, yaw + math.pi / 2
            return staged(reach(self.robot, self.block, yaws), 0.0, 0.0, 0.0)
        lifted = share(self.robot.tool_pose()[0][2], 0.0, self.height_m)
        outside_m = self.distance_m() - self.settings.parameters.tolerance_m
        return staged(1.0, 1.0, lifted, nearness(outside_m))

    def expert_command(self):
        """Grasp the block, then carry it over the plate."""
        if grasped_body(self.robot) is not self.block:
            return grasp(self.robot, self.block, self.action_limits)
        x, y, _ = self.plate.position
        _, yaw = self.robot.tool_pose()
        return move_toward(self.robot, (x, y, self.height_m + 0.03), yaw, CLOSED)
