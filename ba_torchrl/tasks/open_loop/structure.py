"""What the open-loop tasks share that build something from pieces."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from ba_torchrl.actions import PICK, PLACE, PickPlaceCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, Shape
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.base import Spot
from ba_torchrl.tasks.building import Building, Move, PutDown
from ba_torchrl.tasks.experts import finger_room
from ba_torchrl.tasks.open_loop.base import OpenLoopTask
from ba_torchrl.tasks.structures import Blueprint, Piece


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
        move = self.building.next_move(self._put_down(), held, self._effort)
        if move is None:  # it stands: a pick from the bare corner changes nothing
            x, y = self.settings.workspace.x[0], self.settings.workspace.y[0]
            return PickPlaceCommand(PLACE if held is not None else PICK, x, y, 0.1)
        if move.body is held:
            return self._place(move)
        yaw = max(self._grasp_yaws(move.body), key=lambda yaw: self._room(move.body, yaw))
        x, y, z = move.body.position
        return PickPlaceCommand(PICK, x, y, z, yaw)

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

    def _room(self, body: Body, yaw_rad: float) -> float:
        others = [other for other in self.bodies if other is not body]
        return finger_room(self.robot, body, yaw_rad, others)

    def _effort(self, body: Body) -> float:
        """Prefer pieces that stand free."""
        room = max(self._room(body, yaw) for yaw in self._grasp_yaws(body))
        return 0.0 if room > 0 else 1.0

    def _place(self, move: Move) -> PickPlaceCommand:
        """Return the place that brings what is held to where it goes."""
        tool, tool_yaw = self.robot.tool_pose()
        body_yaw = move.piece.yaw_rad(move.body)
        yaw = tool_yaw
        if move.yaw_rad is not None:
            yaw += wrap_angle(move.yaw_rad - body_yaw, move.yaw_period_rad)
        if not self.reach.turn_rad:
            yaw = 0.0
        cos, sin = math.cos(yaw - tool_yaw), math.sin(yaw - tool_yaw)
        ox, oy, oz = (b - t for b, t in zip(move.body.position, tool, strict=True))
        x, y, z = move.position
        return PickPlaceCommand(
            PLACE, x - (cos * ox - sin * oy), y - (sin * ox + cos * oy), z - oz, yaw
        )
