"""Block in Bowl: pick up a block and place it inside a bowl (appendix A.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from ba_torchrl.core.actions import GripperCommand
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.meshes import bowl_parts, centroid
from ba_torchrl.sim.shapes import Solid
from ba_torchrl.tasks.base import BLUE, TASKS, CloseLoopTask
from ba_torchrl.tasks.instructions import colored
from ba_torchrl.tasks.manipulation.primitives import CLOSED, OPEN, grasped_body, move_toward
from ba_torchrl.tasks.manipulation.progress_terms import nearness, reach, share, staged
from ba_torchrl.tasks.manipulation.transport import pick_up, travel
from ba_torchrl.tasks.workspace import Spacing, random_points

RELEASE_GAP_M = 4e-3
"""Height of the block above the floor of the bowl at its release; it lands before the action
ends."""


@TASKS.register("close_loop/block_in_bowl")
class BlockInBowl(CloseLoopTask):
    """Objects: a cubic block of 5 cm and a bowl of 16 x 16 x 7 cm.

    Goal: the block lies inside the upright bowl and is not held. The episode ends early when the
    bowl tips over or an object leaves the workspace. Paper, appendix A.2.
    """

    scale_limits = (0.75, 1.0)
    bowl_radius_m: ClassVar[float] = 0.08
    """Outer radius of the bowl at scale 1, metres."""
    bowl_height_m: ClassVar[float] = 0.07
    """Height of the bowl at scale 1, metres."""
    floor_m: ClassVar[float] = 0.016
    """Height of the inner floor above the lower end of the bowl at scale 1, metres."""
    inside_m: ClassVar[float] = 0.03
    """Largest horizontal distance between a block inside the bowl and its axis at scale 1,
    metres."""
    upright_rad: ClassVar[float] = math.pi / 9
    """Largest tilt of an upright bowl, radians."""
    tipped_rad: ClassVar[float] = math.pi / 3
    """Tilt above which the bowl does not fall back onto its foot, radians."""
    clearance_m: ClassVar[float] = 8e-3
    """Gap between the block and the rim that it passes over, metres."""
    within_rim_m: ClassVar[float] = 0.03
    """Distance from the axis of the bowl within which a block at any yaw fits between the walls, at
    scale 1, metres."""

    def load_scene(self) -> None:
        """Load the block and the bowl."""
        scale = self.settings.scale
        parts = tuple(
            bowl_parts(
                self.bowl_radius_m * scale,
                self.bowl_height_m * scale,
                foot_radius_m=0.045 * scale,
                floor_m=self.floor_m * scale,
                wall_m=0.006 * scale,
            )
        )
        self.block = self.world.add(self.cube(), "block")
        self.bowl = self.world.add(
            Solid(parts=parts, color=BLUE, center_of_mass_m=centroid(parts)), "bowl"
        )

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place block and bowl at random poses, at least 17 cm apart."""
        block = 2.4 * self.block_m
        bowl = 0.17 * self.settings.scale
        spacings = Spacing(block, block), Spacing(bowl, bowl)
        points = random_points(self.terrain.spawn_area, rng, spacings)
        for body, xy in zip((self.block, self.bowl), points, strict=True):
            self.stand(body, xy, self.random_yaw(rng, math.pi))

    def evaluate(self) -> dict[str, bool]:
        """Return whether the block lies inside the upright bowl, released."""
        (x, y, z), (bowl_x, bowl_y, bowl_z) = self.block.position, self.bowl.position
        floor_z = bowl_z - self.bowl.shape.height_m / 2 + self.floor_m * self.settings.scale
        return {
            "is_over_bowl": math.dist((x, y), (bowl_x, bowl_y))
            < self.inside_m * self.settings.scale,
            "is_above_bowl_floor": z > floor_z,  # false below an overturned bowl
            "is_bowl_upright": self.bowl.tilt_rad < self.upright_rad,
            "is_touching_bowl": self.bowl.touches(self.block),
            "is_released": self.robot.held_body() is not self.block,
        }

    def is_valid(self) -> bool:
        """Whether block and bowl are inside the workspace and the bowl has not tipped over."""
        return super().is_valid() and self.bowl.tilt_rad < self.tipped_rad

    def instruction(self) -> str:
        """Return the instruction with the colours of block and bowl."""
        return f"put the {colored(self.block, 'block')} into the {colored(self.bowl, 'bowl')}"

    def progress(self) -> float:
        """Return the progress in five stages: reach, grasp, raise, move over the bowl, lower.

        The last three also count for a block that is released in the bowl.
        """
        block, scale = self.block, self.settings.scale
        low, rim = vertical_extent(block)[0], vertical_extent(self.bowl)[1]
        aside_m = math.dist(block.position[:2], self.bowl.position[:2])
        outside_m = aside_m - self.within_rim_m * scale
        is_within = outside_m <= 0
        if self.robot.held_body() is not block and not (is_within and low < rim):
            yaw = block.yaw_rad
            return staged(reach(self.robot, block, (yaw, yaw + math.pi / 2)), 0.0, 0.0, 0.0, 0.0)
        foot = self.bowl.position[2] - self.bowl.shape.height_m / 2
        raised = 1.0 if is_within else share(low, foot, rim + self.clearance_m)
        lowered = share(low, rim, foot + self.floor_m * scale) if is_within else 0.0
        return staged(1.0, 1.0, raised, nearness(outside_m), lowered)

    def expert_command(self) -> GripperCommand:
        """Grasp the block, carry it over the rim and release it inside."""
        if grasped_body(self.robot) is self.block:
            return self._carry()
        return pick_up(
            self.robot,
            self.block,
            self.action_limits,
            yaws_rad=(self.block.yaw_rad, self.block.yaw_rad + math.pi / 2),
            obstacles=(self.bowl,),
            ceiling_m=self.settings.workspace.z[1],
        )

    def _carry(self) -> GripperCommand:
        """Carry the block over the rim, lower it between the walls and release it."""
        (x, y, z), yaw = self.robot.tool_pose()
        block_x, block_y, _ = self.block.position
        bowl_x, bowl_y, bowl_z = self.bowl.position
        dx, dy = bowl_x - block_x, bowl_y - block_y
        low, _ = vertical_extent(self.block)
        floor_z = bowl_z - self.bowl.shape.height_m / 2 + self.floor_m * self.settings.scale
        if math.hypot(dx, dy) <= self.within_rim_m * self.settings.scale:
            down = low - floor_z - RELEASE_GAP_M
            is_last = max(down, abs(dx), abs(dy)) <= self.action_limits.step_m
            return move_toward(
                self.robot, (x + dx, y + dy, z - down), yaw, OPEN if is_last else CLOSED
            )
        top = vertical_extent(self.bowl)[1]
        return travel(
            self.robot,
            (x + dx, y + dy, z - low + top + self.clearance_m),
            yaw,
            CLOSED,
            below_m=z - low,
            obstacles=(self.bowl,),
            ceiling_m=self.settings.workspace.z[1],
            clearance_m=self.clearance_m,
        )

    @property
    def objects(self) -> Sequence[Body]:
        """Block and bowl."""
        return (self.block, self.bowl)
