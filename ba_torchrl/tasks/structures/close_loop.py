"""Structures under close-loop control: the base of the tasks that build one, and their expert."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from ba_torchrl.actions import GripperCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.shapes import Color
from ba_torchrl.tasks.base import Task
from ba_torchrl.tasks.clearance import grasp_clearance_m
from ba_torchrl.tasks.close_loop_task import BLUE, GREEN, RED, CloseLoopControl
from ba_torchrl.tasks.motion_primitives import (
    OPEN,
    carry_to,
    lift,
    nearest_equivalent_yaw,
    pick_up,
)
from ba_torchrl.tasks.structures.blocking import GraspQueries
from ba_torchrl.tasks.structures.blueprint import Blueprint
from ba_torchrl.tasks.structures.free_space import PlacementArea
from ba_torchrl.tasks.structures.planner import StructurePlanner
from ba_torchrl.tasks.structures.structure import Structure
from ba_torchrl.tasks.terrain import Terrain
from ba_torchrl.tasks.workspace import ActionLimits, Spot

NO_ROOM_M = 1.0
"""Cost of a piece that no grasp reaches, in metres of detour."""

COLORS: tuple[Color, ...] = (RED, BLUE, (0.9, 0.6, 0.2, 1.0), GREEN)
"""Of the cubes, from the bottom up."""


class CloseLoopStructureTask(CloseLoopControl, Task):
    """Pieces scattered on the ground; success when they stand as the blueprint says, released.

    A piece that must stay upright and has tipped over ends the episode: a gripper that points down
    can lift it, but not turn it upright.
    """

    spot_blocks: ClassVar[dict[int, Spot]] = {
        2: Spot(2.4, 2.4),
        3: Spot(2.4, 2.4),
        4: Spot(1.6, 2.0),
    }
    """Space around each piece at the start in blocks, by the number of pieces: four are closer."""

    @abstractmethod
    def blueprint(self) -> Blueprint:
        """Return the structure."""

    def load_scene(self) -> None:
        """Load the pieces."""
        self.structure = Structure(
            self.blueprint(),
            self.world,
            self.block_m,
            self.terrain.support_ids,
            largest_first=False,
        )

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Put the pieces anywhere, with room for the fingers between them.

        With fixed orientations a gripper at yaw 0 closes on each of them.
        """
        self.structure.draw(rng)
        pieces = self.structure.pieces
        padding, distance = self.spot_blocks[len(pieces)]
        spots = [Spot(padding * self.block_m, distance * self.block_m)] * len(pieces)
        for (body, piece), xy in zip(pieces.items(), self.random_points(rng, spots), strict=True):
            fixed_yaw = -piece.grasp_yaws_rad[0] % math.pi
            self.stand(body, xy, fixed_yaw + self.random_yaw(rng, piece.yaw_period_rad))

    @property
    def planner(self) -> StructurePlanner:
        """Compares the pieces with the blueprint."""
        return self.structure.planner

    @property
    def objects(self) -> Sequence[Body]:
        """The pieces."""
        return list(self.structure.pieces)

    def evaluate(self) -> dict[str, bool]:
        """Return whether the structure stands, with none of its pieces in the gripper."""
        return self.planner.evaluate(self.robot.held_body())

    def is_valid(self) -> bool:
        """Whether all pieces are inside the workspace, and upright where they must be."""
        return super().is_valid() and not self.planner.has_tipped(self.robot.held_body())

    def expert_command(self) -> GripperCommand:
        """Move the piece that comes next."""
        return assemble(self.robot, self.planner, self.terrain, self.action_limits)


def assemble(
    robot: Robot,
    planner: StructurePlanner,
    terrain: Terrain,
    limits: ActionLimits,
) -> GripperCommand:
    """Pick the piece that comes next and place it; a function of the scene, from any state.

    Args:
        robot: the robot.
        planner: compares the pieces with the blueprint.
        terrain: where pieces may be put down.
        limits: of an action.
    """
    (x, y, _), yaw = robot.tool_pose()
    held = robot.held_body() if robot.opening() < 0.9 else None
    pieces = list(planner.pieces)

    def yaws(body: Body) -> list[float]:
        return planner.pieces[body].grasp_yaws(body) if limits.turn_rad else [yaw]

    class Queries(GraspQueries):
        """The nearest piece first, those that no grasp reaches last."""

        def pick_effort_m(self, body: Body) -> float:
            others = [other for other in pieces if other is not body]
            room = max(
                grasp_clearance_m(robot.gripper, body, option, others) for option in yaws(body)
            )
            return math.dist((x, y), body.position[:2]) + (0.0 if room > 0 else NO_ROOM_M)

    area = PlacementArea(
        *terrain.build_area.shrunk(1.2 * planner.block_m),
        gap_m=planner.block_m,
        height_m=terrain.height_m,
    )
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
        ahead = move.yaw_rad - move.piece.yaw_rad(held)
        target_yaw = nearest_equivalent_yaw(yaw, yaw + ahead, limits, move.yaw_period_rad)
    return carry_to(
        robot,
        held,
        move.position,
        limits,
        yaw_rad=target_yaw,
        obstacles=pieces,
        ceiling_m=ceiling_m,
    )
