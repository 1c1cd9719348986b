"""Block Stacking: put blocks on top of each other (appendix A.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ba_torchrl.actions import GripperCommand
from ba_torchrl.sim.bodies import Body, Color
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.base import TASKS, Spot
from ba_torchrl.tasks.close_loop_task import BLUE, GREEN, RED, CloseLoopTask
from ba_torchrl.tasks.structures.blueprint import CUBE, tower
from ba_torchrl.tasks.structures.close_loop import assemble
from ba_torchrl.tasks.structures.planner import StructurePlanner

COLORS: tuple[Color, ...] = (RED, BLUE, (0.9, 0.6, 0.2, 1.0), GREEN)

_ROOM = {2: (2.4, 2.4), 3: (2.4, 2.4), 4: (1.6, 2.0)}
"""Padding and distance in blocks for a number of pieces; four of them stand closer."""


def scattered(count: int, block_m: float) -> list[Spot]:
    """Return the room that each of so many pieces gets at the start."""
    padding, distance = _ROOM[count]
    return [Spot(padding * block_m, distance * block_m)] * count


@TASKS.register("close_loop/block_stacking")
class BlockStacking(CloseLoopTask):
    """Cubes of 5 cm, two unless told otherwise; success when they stand in a stack, let go of.

    Five would fit the workspace, but not the 50 steps.
    """

    num_objects = 2
    num_objects_range = (2, 4)

    def build(self, world: World) -> None:
        """Load the cubes."""
        count = self.settings.num_objects
        self.blocks = [
            world.add(self.cube(color), f"block {i + 1}") for i, color in enumerate(COLORS[:count])
        ]
        self.stack = StructurePlanner(
            tower(*[CUBE] * count), world, {CUBE.kind: self.blocks}, self.block_m
        )

    def randomise(self, rng: np.random.Generator) -> None:
        """Put the cubes anywhere with room for the fingers between them."""
        spots = scattered(len(self.blocks), self.block_m)
        for block, xy in zip(self.blocks, self.random_points(rng, spots), strict=True):
            self.stand(block, xy, self.random_yaw(rng, math.pi / 2))

    def is_goal(self) -> bool:
        """Whether every cube but the lowest rests on the next, within half a cube of its centre."""
        return self.stack.is_built(self.robot.held_body())

    def expert_command(self) -> GripperCommand:
        """Stack the cube that is handier on the highest."""
        settings = self.settings
        return assemble(
            self.robot, self.stack, settings.workspace, self.action_limits, settings.surface_z_m
        )

    @property
    def objects(self) -> Sequence[Body]:
        """The cubes."""
        return self.blocks
