"""What the open-loop tasks share that build something from pieces."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from ba_torchrl.actions import PICK, PLACE, PickPlaceCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, Shape, Vector, radius_m
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.base import Spot
from ba_torchrl.tasks.building import Building, Move, PutDown
from ba_torchrl.tasks.experts import finger_room
from ba_torchrl.tasks.open_loop.base import OpenLoopTask
from ba_torchrl.tasks.structures import Blueprint, Piece

HAND_M = 0.07
"""From the middle of the open gripper to its outermost part, and a little more."""
CROWDED = 10.0
"""What a metre too near is worth in metres of way."""
FREE_YAWS = 8
"""Yaws of a half turn that are tried where any will do."""
AMPLE_M = 0.02
"""More room than this is no better."""


class Part(NamedTuple):
    """A piece of a structure: what it is in the blueprint, and in the world."""

    piece: Piece
    shape: Shape
    spot: Spot
    """Room that it gets at the start."""


class StructureTask(OpenLoopTask):
    """Pieces scattered on the floor; success when they stand as the blueprint says."""

    tipping_ends: ClassVar[bool] = True
    """Whether a piece on its side, such as a roof, ends the episode."""

    @abstractmethod
    def blueprint(self) -> Blueprint:
        """Return what is to be built."""

    @abstractmethod
    def parts(self) -> Sequence[Part]:
        """Return the pieces, those that need most room first."""

    def build(self, world: World) -> None:
        """Load the pieces."""
        self._parts = list(self.parts())
        self.bodies: list[Body] = []
        kinds: dict[str, list[Body]] = {}
        for part in self._parts:
            mates = kinds.setdefault(part.piece.kind, [])
            body = world.add(part.shape, f"{part.piece.kind} {len(mates) + 1}")
            mates.append(body)
            self.bodies.append(body)
        self.building = Building(self.blueprint(), world, kinds, self.block_m)

    def randomise(self, rng: np.random.Generator) -> None:
        """Put the pieces anywhere apart from each other.

        Fixed orientations are those at which a gripper that does not turn can grasp them.
        """
        points = self.random_points(rng, [part.spot for part in self._parts])
        for part, body, xy in zip(self._parts, self.bodies, points, strict=True):
            yaw = self.random_yaw(rng, 2 * math.pi) - part.piece.grasp_yaws_rad[0]
            self.stand(body, xy, yaw)

    def is_goal(self) -> bool:
        """Whether the structure stands, let go of."""
        return self.building.is_built(self.robot.held_body())

    def is_valid(self) -> bool:
        """Whether all is inside the workspace, and nothing on its side that must not be."""
        if not super().is_valid():
            return False
        return not (self.tipping_ends and self.building.has_tipped(self.robot.held_body()))

    @property
    def objects(self) -> Sequence[Body]:
        """The pieces."""
        return self.bodies

    def expert_command(self) -> PickPlaceCommand:
        """Move the piece that comes next, from any state."""
        held = self.robot.held_body()
        move = self.building.next_move(self._put_down(), held, self._effort, self._crowding)
        if move is None:  # it stands: a pick from the bare corner changes nothing
            x, y = self.settings.workspace.x[0], self.settings.workspace.y[0]
            return PickPlaceCommand(PLACE if held is not None else PICK, x, y, 0.1)
        if move.body is held:
            return self._place(move)
        yaw = max(self._grasp_yaws(move.body), key=lambda yaw: self._room(move.body, yaw))
        x, y, z = move.body.position
        return PickPlaceCommand(PICK, x, y, z, yaw)

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the square searched for the highest point.

        A long piece may rest on what is far from its middle.
        """
        if held is None:
            return super().window_m(held)
        low, high = held.shape.bounds_m
        longest = max(high[0] - low[0], high[1] - low[1])
        return max(super().window_m(held), 0.375 * longest)

    # ----------------------------------------------------------------------------------------

    def _put_down(self) -> PutDown:
        border = 1.5 * self.block_m
        (x0, x1), (y0, y1) = self.settings.workspace.x, self.settings.workspace.y
        return PutDown((x0 + border, x1 - border), (y0 + border, y1 - border), 2.0 * self.block_m)

    def _grasp_yaws(self, body: Body) -> list[float]:
        """Return the yaws to grasp a body at; a gripper that does not turn has one."""
        if not self.reach.turn_rad:
            return [0.0]
        return self.building.pieces[body].grasp_yaws(body)

    def _room(self, body: Body, yaw_rad: float, at: Vector | None = None) -> float:
        others = [other for other in self.bodies if other is not body]
        return finger_room(self.robot, body, yaw_rad, others, self.finger_opening, at)

    def _crowding(self, body: Body, position: Vector) -> float:
        """Prefer sites at which the hand will not meet the structure when it fetches the rest."""
        return CROWDED * sum(
            max(radius_m(other) + HAND_M - math.dist(other.position[:2], position[:2]), 0.0)
            for other in self.bodies
            if self.building.pieces[other] != self.building.pieces[body]
        )

    def _effort(self, body: Body) -> float:
        """Prefer pieces that stand free."""
        room = max(self._room(body, yaw) for yaw in self._grasp_yaws(body))
        return 0.0 if room > 0 else 1.0

    def _place(self, move: Move) -> PickPlaceCommand:
        """Return the place that brings what is held to where it goes."""
        tool, tool_yaw = self.robot.tool_pose()
        yaw = tool_yaw
        if not self.reach.turn_rad:
            yaw = 0.0
        elif move.yaw_rad is None:
            turns = [math.pi * i / FREE_YAWS for i in range(FREE_YAWS)]
            yaw = self._roomiest(move, turns)
        else:
            ahead = tool_yaw + wrap_angle(move.yaw_rad - move.piece.yaw_rad(move.body))
            count = max(1, round(math.pi / move.yaw_period_rad))  # a half turn swaps the fingers
            yaw = self._roomiest(move, [ahead + move.yaw_period_rad * i for i in range(count)])
        cos, sin = math.cos(yaw - tool_yaw), math.sin(yaw - tool_yaw)
        ox, oy, oz = (b - t for b, t in zip(move.body.position, tool, strict=True))
        x, y, z = move.position
        return PickPlaceCommand(
            PLACE, x - (cos * ox - sin * oy), y - (sin * ox + cos * oy), z - oz, yaw
        )

    def _roomiest(self, move: Move, yaws_rad: Sequence[float]) -> float:
        """Return the first of the yaws at which the fingers can part most freely."""
        rooms = [min(self._room(move.body, yaw, move.position), AMPLE_M) for yaw in yaws_rad]
        return yaws_rad[rooms.index(max(rooms))]
