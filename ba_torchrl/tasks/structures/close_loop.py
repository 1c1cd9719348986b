"""Structures under close-loop control: the base of the tasks that build one, and their expert."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import ClassVar

import numpy as np

from ba_torchrl.actions import GripperCommand
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
from ba_torchrl.tasks.structures.blocking import GraspQueries
from ba_torchrl.tasks.structures.blueprint import Blueprint
from ba_torchrl.tasks.structures.free_space import PlacementArea
from ba_torchrl.tasks.structures.goal import StructureGoal
from ba_torchrl.tasks.structures.planner import StructurePlanner
from ba_torchrl.tasks.structures.structure import Structure
from ba_torchrl.tasks.terrain.flat import Terrain
from ba_torchrl.tasks.workspace import ActionLimits, Spacing

BLOCKED_COST_M = 1.0
"""Cost of picking a piece whose grasps all lack clearance."""

COLORS: tuple[Color, ...] = (RED, BLUE, (0.9, 0.6, 0.2, 1.0), GREEN)
"""Colors of the cubes, from the bottom up."""


class CloseLoopStructureTask(StructureGoal, CloseLoopTask):
    """Pieces at random poses on the ground; success when they form the blueprint's structure.

    The episode ends when a piece that must stay upright tips over: a gripper that points down
    cannot turn it upright.
    """

    spacing_blocks: ClassVar[dict[int, Spacing]] = {
        2: Spacing(2.4, 2.4),
        3: Spacing(2.4, 2.4),
        4: Spacing(1.6, 2.0),
    }
    """Space around each piece at the start, in blocks, by the number of pieces; that of the largest
    number also for more."""

    @abstractmethod
    def blueprint(self) -> Blueprint:
        """Return the structure."""

    def load_scene(self) -> None:
        """Load the pieces."""
        self.structure = Structure(
            self.blueprint(),
            self.world,
            self.block_m,
            self.terrain,
            largest_first=False,
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
        points = self.random_points(rng, [spacing] * len(pieces))
        for (body, piece), xy in zip(pieces.items(), points, strict=True):
            fixed_yaw = -piece.grasp_yaws_rad[0] % math.pi
            self.stand(body, xy, fixed_yaw + self.random_yaw(rng, piece.yaw_period_rad))

    def is_valid(self) -> bool:
        """Whether all pieces are inside the workspace, and upright where required."""
        return super().is_valid() and not self.planner.has_tipped(self.robot.held_body())

    def expert_command(self) -> GripperCommand:
        """Return the command of the planner's next move."""
        return assemble(self.robot, self.planner, self.terrain, self.action_limits)


def assemble(
    robot: Robot,
    planner: StructurePlanner,
    terrain: Terrain,
    limits: ActionLimits,
) -> GripperCommand:
    """Return the command of the planner's next move, from any state of the scene.

    Args:
        robot: the robot.
        planner: compares the pieces with the blueprint.
        terrain: the ground.
        limits: limits of an action.
    """
    (x, y, _), yaw = robot.tool_pose()
    held = grasped_body(robot)
    pieces = list(planner.pieces)

    def yaws(body: Body) -> list[float]:
        return planner.pieces[body].grasp_yaws(body) if limits.turn_rad else [yaw]

    class Queries(GraspQueries):
        """Prefers the nearest piece, and pieces with a free grasp to all others."""

        def pick_cost_m(self, body: Body) -> float:
            others = [other for other in pieces if other is not body]
            clearance = max(
                grasp_clearance_m(robot.gripper, body, option, others) for option in yaws(body)
            )
            distance = math.dist((x, y), body.position[:2])
            return distance + (0.0 if clearance > 0 else BLOCKED_COST_M)

    region = terrain.build_area.shrunk(1.2 * planner.block_m)
    area = PlacementArea(terrain, region, region, gap_m=planner.block_m)
    move = planner.next_move(area, held, Queries())
    if move is None:
        return lift(limits.step_m, OPEN)
    ceiling_m = terrain.workspace.z[1]
    if move.body is not held:
        return pick_up(
            robot,
            move.body,
            limits,
            yaws_rad=yaws(move.body),
            obstacles=pieces,
            ceiling_m=ceiling_m,
        )
    target_yaw = None
    if move.yaw_rad is not None:
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
