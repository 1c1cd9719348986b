"""House Building: stack blocks and put a triangle on top (appendix A.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ba_torchrl.actions import GripperCommand
from ba_torchrl.sim.bodies import Body, Solid
from ba_torchrl.sim.meshes import gable_mesh
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.close_loop.block_stacking import COLORS, scattered
from ba_torchrl.tasks.close_loop_task import GREEN, CloseLoopTask
from ba_torchrl.tasks.structures.blueprint import CUBE, TRIANGLE, tower
from ba_torchrl.tasks.structures.close_loop import assemble
from ba_torchrl.tasks.structures.planner import StructurePlanner


@TASKS.register("close_loop/house_building")
class HouseBuilding(CloseLoopTask):
    """Cubes of 5 cm and a triangle of that size; success when it tops the stack, let go of.

    A triangle that has tipped over ends the episode: a gripper that points down can lift it, but
    not turn it upright.
    """

    num_objects = 2
    num_objects_range = (2, 4)

    def build(self, world: World) -> None:
        """Load the cubes and the triangle."""
        colors = COLORS[: self.settings.num_objects - 1]
        edge = self.block_m
        self.blocks = [
            world.add(self.cube(color), f"block {i + 1}") for i, color in enumerate(colors)
        ]
        prism = Solid(
            parts=(gable_mesh((edge, edge, edge)),),
            color=GREEN,
            center_of_mass_m=(0.0, 0.0, -edge / 6),
        )
        self.triangle = world.add(prism, "triangle")
        self.house = StructurePlanner(
            tower(*[CUBE] * len(self.blocks), TRIANGLE),
            world,
            {CUBE.kind: self.blocks, TRIANGLE.kind: [self.triangle]},
            edge,
        )

    def randomise(self, rng: np.random.Generator) -> None:
        """Put the pieces anywhere with room for the fingers between them.

        With fixed orientations the ridge points along x, for fingers that close on its ends.
        """
        spots = scattered(len(self.objects), self.block_m)
        for body, xy in zip(self.objects, self.random_points(rng, spots), strict=True):
            if body is self.triangle:
                self.stand(body, xy, math.pi / 2 + self.random_yaw(rng, math.pi))
            else:
                self.stand(body, xy, self.random_yaw(rng, math.pi / 2))

    def is_goal(self) -> bool:
        """Whether the cubes form a stack and the triangle stands on it, nothing on top."""
        return self.house.is_built(self.robot.held_body())

    def is_valid(self) -> bool:
        """Whether all is inside the workspace and the triangle upright, or in the gripper."""
        return super().is_valid() and not self.house.has_tipped(self.robot.held_body())

    def expert_command(self) -> GripperCommand:
        """Stack the cubes, the handier ones first, then put the triangle on top."""
        settings = self.settings
        return assemble(
            self.robot, self.house, settings.workspace, self.action_limits, settings.surface_z_m
        )

    @property
    def objects(self) -> Sequence[Body]:
        """The cubes and the triangle."""
        return [*self.blocks, self.triangle]
