"""The tasks that build a structure with small displacements of the gripper, and their expert."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from ba_torchrl.core.actions import GripperCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.shapes import Color
from ba_torchrl.tasks.base import BLUE, GREEN, RED, CloseLoopTask
from ba_torchrl.tasks.manipulation.clearance import grasp_clearance_m
from ba_torchrl.tasks.manipulation.primitives import (
    OPEN,
    grasped_body,
    lift,
    nearest_equivalent_yaw,
)
from ba_torchrl.tasks.manipulation.transport import carry_to, pick_up
from ba_torchrl.tasks.structures.base import StructureGoal
from ba_torchrl.tasks.structures.free_space import PlacementArea
from ba_torchrl.tasks.structures.moves import Grasps
from ba_torchrl.tasks.structures.planner import next_move
from ba_torchrl.tasks.structures.structure import Structure
from ba_torchrl.tasks.workspace import ActionLimits, Spacing, random_points

COLORS: tuple[Color, ...] = (RED, BLUE, (0.9, 0.6, 0.2, 1.0), GREEN)
"""Colors of the cubes in close loop, from the bottom up."""
BORDER_BLOCKS = 1.2
"""Distance of placements from the border of their area, in blocks."""
BLOCKED_COST_M = 1.0
"""Cost of picking a piece whose grasps all lack clearance."""


class CloseLoopStructureTask(StructureGoal, CloseLoopTask):
    """A structure in close loop."""

    spacing_blocks: ClassVar[dict[int, Spacing]] = {
        2: Spacing(2.4, 2.4),
        3: Spacing(2.4, 2.4),
        4: Spacing(1.6, 2.0),
    }
    """Space around each piece at the start, in blocks, by the number of pieces; the largest
    number's also for more."""

    def load_scene(self) -> None:
        """Load the pieces."""
        self.structure = Structure(
            self.blueprint(), self.world, self.block_m, self.terrain, largest_first=False
        )

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place the pieces at random poses, with clearance for the fingers.

        With fixed orientations, a gripper at yaw 0 can grasp each of them.
        """
        self.structure.draw(rng)
        pieces = self.structure.pieces
        spacings = self.spacing_blocks
        padding, distance = spacings.get(len(pieces), spacings[max(spacings)])
        spacing = Spacing(padding * self.block_m, distance * self.block_m)
        points = random_points(self.terrain.spawn_area, rng, [spacing] * len(pieces))
        for (body, piece), xy in zip(pieces.items(), points, strict=True):
            fixed_yaw = -piece.grasp_yaws_rad[0] % math.pi
            self.stand(body, xy, fixed_yaw + self.random_yaw(rng, piece.yaw_period_rad))

    def expert_command(self) -> GripperCommand:
        """Return the command of the planner's next move."""
        robot, limits, structure = self.robot, self.action_limits, self.structure
        held, grasps = grasped_body(robot), CloseLoopGrasps(structure, robot, limits)
        region = self.terrain.build_area.shrunk(BORDER_BLOCKS * self.block_m)
        area = PlacementArea(self.terrain, region, region, gap_m=self.block_m)
        move = next_move(structure.assigner(held), area, grasps)
        if move is None:
            return lift(limits.step_m, OPEN)
        pieces, ceiling_m = list(structure.pieces), self.terrain.workspace.z[1]
        if move.body is not held:
            return pick_up(
                robot,
                move.body,
                limits,
                yaws_rad=grasps.yaws(move.body),
                obstacles=pieces,
                ceiling_m=ceiling_m,
            )
        target_yaw = None
        if move.yaw_rad is not None:
            yaw = robot.tool_pose()[1]
            turn = move.yaw_rad - move.piece.yaw_rad(held)
            target_yaw = nearest_equivalent_yaw(yaw, yaw + turn, limits, move.yaw_period_rad)
        return carry_to(
            robot,
            held,
            move.position,
            limits,
            yaw_rad=target_yaw,
            obstacles=pieces,
            ceiling_m=ceiling_m,
        )


class CloseLoopGrasps(Grasps):
    """The grasps of the close-loop expert: the nearest piece first, those with a free grasp before
    all others.

    Args:
        limits: limits of an action; a gripper that cannot turn keeps its yaw.
    """

    def __init__(self, structure: Structure, robot: Robot, limits: ActionLimits) -> None:
        self.structure = structure
        self.robot = robot
        self.limits = limits

    def yaws(self, body: Body) -> list[float]:
        """Return the yaws of the gripper at which it can grasp a body."""
        if not self.limits.turn_rad:
            return [self.robot.tool_pose()[1]]
        return self.structure.pieces[body].grasp_yaws(body)

    def pick_cost_m(self, body: Body) -> float:
        """Return the distance of a piece from the tool, and a cost if its grasps are blocked."""
        others = [other for other in self.structure.pieces if other is not body]
        clearance_m = max(
            grasp_clearance_m(self.robot.gripper, body, yaw, others) for yaw in self.yaws(body)
        )
        distance_m = math.dist(self.robot.tool_pose()[0][:2], body.position[:2])
        return distance_m + (0.0 if clearance_m > 0 else BLOCKED_COST_M)
