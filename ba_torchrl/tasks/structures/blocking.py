"""Access: whether the hand can reach a piece between others, and what would have to go first."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Vector
from ba_torchrl.sim.robots.gripper import Gripper
from ba_torchrl.tasks.structures.blueprint import Piece
from ba_torchrl.tasks.structures.free_space import extent_along_m

SPARE_M = 2e-3
"""Room between a piece and a finger that comes down close by it."""


class GraspQueries:
    """What the planner asks about the gripper; here, that of a gripper that needs no room."""

    clears_blocked_pieces: bool = False
    """Whether pieces that block the grasp of another are removed."""

    def pick_effort_m(self, body: Body) -> float:
        """Return what to add to the way of a piece for picking it, to choose among equals."""
        return 0.0

    def site_deficit_m(self, sites: np.ndarray, rest: Sequence[Body]) -> np.ndarray:
        """Return how much clearance is missing at sites to pick the other pieces later, [S].

        Args:
            sites: [S, P, 2] points on the ground that a structure will stand on.
            rest: pieces that will still have to be picked.
        """
        return np.zeros(len(sites))

    def blocks_grasp(self, body: Body, other: Body, place: Vector | None) -> Sequence[bool]:
        """Return whether a piece is in the hand's way, for each of the ways to grasp another.

        Args:
            body: to be grasped.
            other: the piece.
            place: its position then; None where it is now.
        """
        return (False,)


class Move(NamedTuple):
    """What to pick and where to place it."""

    body: Body
    piece: Piece
    position: Vector
    """Where its origin goes."""
    yaw_rad: float | None
    """Its heading up to multiples of the period; None if any will do."""
    yaw_period_rad: float
    onto: tuple[Body, ...]
    """What it will rest on; nothing stands for the ground."""


class GraspCandidate(NamedTuple):
    """A way to grasp a piece; distances are from its origin, along the gripper's x axis."""

    yaw_rad: float
    shift_m: float = 0.0
    """Where the tool is; in the middle of the piece if zero."""
    far_finger_range_m: tuple[float, float] = (0.0, 0.0)
    """What one finger sweeps on its way to the piece if the tool is off the middle."""
    near_finger_range_m: tuple[float, float] = (0.0, 0.0)
    """Where the other one comes down then, close by the piece."""


def edge_grasps(
    gripper: Gripper, body: Body, yaw_rad: float, opening: float = 1.0
) -> list[GraspCandidate]:
    """Return the ways to come down with one finger close by a body, the other far from it.

    The first needs no more room than its own width. Where that is wanting it wedges itself in all
    the same: between the fingers the body can give way.

    Args:
        gripper: what is to grasp.
        body: stands on the ground, so that it may slide.
        yaw_rad: the gripper's, or its reverse.
        opening: of the gripper, 0 to 1.

    Returns:
        One for each finger; none if the body nearly fills the gripper.
    """
    half_gap_m = opening * gripper.half_gap_m
    finger_m = gripper.finger_depth_m
    candidates = []
    for yaw in (yaw_rad, yaw_rad + math.pi):
        ahead = np.array([math.cos(yaw), math.sin(yaw)])
        far_m, near_m = extent_along_m(body, np.stack([ahead, -ahead])).tolist()
        shift_m = half_gap_m - near_m - SPARE_M
        if shift_m > SPARE_M:
            far_finger_range_m = (far_m, shift_m + half_gap_m + finger_m)
            candidates.append(
                GraspCandidate(
                    yaw, shift_m, far_finger_range_m, (-near_m - SPARE_M - finger_m, -near_m)
                )
            )
    return candidates


class GraspBlocking:
    """The room that pieces leave the hand to grasp each other.

    Args:
        pieces: what each body is.
        bodies_above: all that lies on each, right on it or on what does.
        held: what the gripper holds: it is in no one's way.
        queries: about the gripper.
    """

    def __init__(
        self,
        pieces: Mapping[Body, Piece],
        bodies_above: Mapping[Body, frozenset[Body]],
        held: Body | None,
        queries: GraspQueries,
    ) -> None:
        self.pieces = pieces
        self.bodies_above = bodies_above
        self.held = held
        self.queries = queries
        self._obstacles: dict[Body, list[frozenset[Body]]] = {}

    def obstacles(self, body: Body) -> list[frozenset[Body]]:
        """Return what is in the hand's way, for each of the ways to grasp a body."""
        if not self.queries.clears_blocked_pieces:
            return [frozenset()]
        if body not in self._obstacles:
            others = [other for other in self.pieces if other is not body]
            rows = [self.queries.blocks_grasp(body, other, None) for other in others]
            self._obstacles[body] = [
                frozenset(
                    other
                    for other, blocks in zip(others, way, strict=True)
                    if blocks and other is not self.held
                )
                for way in zip(*rows, strict=True)
            ] or [frozenset()]
        return self._obstacles[body]

    def is_blocked(self, body: Body) -> bool:
        """Whether no way to grasp a body is free."""
        return all(self.obstacles(body))

    def removals(self, assignment: Sequence[Body | None]) -> Iterator[tuple[int, Body, None]]:
        """Yield what could go to the ground to make room for the hand at a piece.

        Args:
            assignment: the body in each slot; these need not be picked.

        Yields:
            How many pieces must go, the one to go first, and None for the ground.
        """
        for body in self.pieces:
            if body not in assignment and body is not self.held:
                gone = self._in_the_way(body) or ()
                for top in gone:
                    if self.bodies_above[top].isdisjoint(gone):
                        yield len(gone), top, None

    def added_removals(self, move: Move, assignment: Sequence[Body | None]) -> int:
        """Return the detours that a move brings: what it builds up beside a piece not yet fetched.

        Args:
            move: to judge.
            assignment: the body in each slot.
        """
        if not self.queries.clears_blocked_pieces:
            return 0
        after, most = self._after(move), 0
        for other in self.pieces:
            if other in assignment or other is move.body or other is self.held:
                continue
            gone = after._in_the_way(other)
            if gone is None and self._in_the_way(other) is not None:
                most = len(self.pieces)
            elif gone is not None and move.body in gone:
                most = max(most, len(gone))
        return most + 2 if most else 0  # taken down, and put up again

    def _in_the_way(self, body: Body) -> frozenset[Body] | None:
        """Return the fewest pieces that must go for the hand to reach a body, None if that fails.

        What is in the way must itself be within reach, if not for the others that go.
        """
        found = []
        for way in self.obstacles(body):
            gone = way.union(*(self.bodies_above[other] for other in way))
            if body not in gone and all(
                any(way <= gone for way in self.obstacles(other)) for other in gone
            ):
                found.append(gone)
        return min(found, key=len, default=None)

    def _after(self, move: Move) -> GraspBlocking:
        """Return how things will be after a move, whose body will be within reach."""
        body, bodies_above = move.body, dict(self.bodies_above)
        for other, pile in self.bodies_above.items():
            if other in move.onto or not pile.isdisjoint(move.onto):
                bodies_above[other] = pile | {body}
        held = None if self.held is body else self.held
        after = GraspBlocking(self.pieces, bodies_above, held, self.queries)
        for other in self.pieces:
            if other is body:
                after._obstacles[other] = [frozenset()]
                continue
            blocks = self.queries.blocks_grasp(other, body, move.position)
            after._obstacles[other] = [
                way | {body} if is_there else way - {body}
                for way, is_there in zip(self.obstacles(other), blocks, strict=True)
            ]
        return after
