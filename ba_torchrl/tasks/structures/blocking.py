"""Blocked grasps: which pieces prevent a grasp, and which of them to remove first."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.geometry import IDENTITY, Quaternion, Vector
from ba_torchrl.sim.robots.gripper import Gripper
from ba_torchrl.tasks.structures.blueprint import Piece
from ba_torchrl.tasks.structures.free_space import extent_along_m

EDGE_CLEARANCE_M = 2e-3
"""Clearance between a piece and the finger that descends close to it."""


class GraspQueries:
    """What `StructurePlanner` asks about the gripper; by default every grasp is free."""

    clears_blocked_pieces: bool = False
    """Whether pieces that block the grasp of another piece are removed."""

    def rise_m(self, body: Body) -> float:
        """Return the height of a piece's origin above its support when it is released."""
        return body.position[2] - vertical_extent(body)[0]

    def pick_cost_m(self, body: Body) -> float:
        """Return the cost of picking a piece, as a distance that is added to that of its move."""
        return 0.0

    def site_deficit_m(self, sites: np.ndarray, rest: Sequence[Body]) -> np.ndarray:
        """Return the clearance [S] that structures at sites lack for picking the remaining pieces.

        Args:
            sites: [S, P, 2] points of the ground that a structure at each site occupies, metres.
            rest: the pieces that remain to be picked.
        """
        return np.zeros(len(sites))

    def blocks_grasp(self, body: Body, other: Body, position: Vector | None) -> Sequence[bool]:
        """Return for each grasp candidate of a piece whether another piece blocks it.

        Args:
            body: the piece to grasp.
            other: the other piece.
            position: assumed position of the other piece; its present one if None.
        """
        return (False,)


class Move(NamedTuple):
    """A piece to pick, and where to place it."""

    body: Body
    piece: Piece
    position: Vector
    """Final position of its origin."""
    yaw_rad: float | None
    """Final yaw up to multiples of the period; None if any yaw is allowed."""
    yaw_period_rad: float
    onto: tuple[Body, ...]
    """The bodies that will support it; empty for the ground."""
    surface: Quaternion = IDENTITY
    """Orientation of a frame whose z axis is the normal of the surface that will support it."""


class GraspCandidate(NamedTuple):
    """A grasp of a piece; distances are from its origin along the gripper's x axis."""

    yaw_rad: float
    shift_m: float = 0.0
    """Position of the tool; 0 for a centred grasp."""
    far_finger_range_m: tuple[float, float] = (0.0, 0.0)
    """Range that the far finger sweeps as it closes, for a grasp with a shift."""
    near_finger_range_m: tuple[float, float] = (0.0, 0.0)
    """Range in which the near finger descends beside the piece, for a grasp with a shift."""
    middle_m: float = 0.0
    """Middle of the piece, at which a centred grasp has the same space for both fingers."""
    along_m: float = 0.0
    """Position of the tool perpendicular to the closing axis, along the length of the piece."""
    tool: Quaternion | None = None
    """Orientation of a tilted tool; None for a tool that points straight down."""


def edge_grasps(
    gripper: Gripper, body: Body, yaw_rad: float, opening: float = 1.0
) -> list[GraspCandidate]:
    """Return the grasps at which one finger descends close to a body and the other far from it.

    The near finger needs no more clearance than its own depth. Even with less the grasp may
    succeed, as the body can slide into the gap between the fingers.

    Args:
        gripper: the gripper.
        body: a body on the ground, on which it can slide.
        yaw_rad: yaw of the gripper, up to half a turn.
        opening: opening of the gripper, 0 to 1.

    Returns:
        One grasp for each finger; none if the body nearly fills the gap between the fingers.
    """
    half_gap_m = opening * gripper.half_gap_m
    finger_m = gripper.finger_depth_m
    candidates = []
    for yaw in (yaw_rad, yaw_rad + math.pi):
        ahead = np.array([math.cos(yaw), math.sin(yaw)])
        far_m, near_m = extent_along_m(body, np.stack([ahead, -ahead])).tolist()
        shift_m = half_gap_m - near_m - EDGE_CLEARANCE_M
        if shift_m > EDGE_CLEARANCE_M:
            far_finger_range_m = (far_m, shift_m + half_gap_m + finger_m)
            near_finger_range_m = (-near_m - EDGE_CLEARANCE_M - finger_m, -near_m)
            candidates.append(GraspCandidate(yaw, shift_m, far_finger_range_m, near_finger_range_m))
    return candidates


class GraspBlocking:
    """Which pieces block the grasps of which others.

    Args:
        pieces: the kind of each body.
        bodies_above: for each body all that it supports, directly or through others.
        held: the body in the gripper; it blocks no grasp.
        queries: answers about the gripper.
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
        """Return for each grasp candidate of a body the pieces that block it."""
        if not self.queries.clears_blocked_pieces:
            return [frozenset()]
        if body not in self._obstacles:
            others = [other for other in self.pieces if other is not body]
            rows = [self.queries.blocks_grasp(body, other, None) for other in others]
            self._obstacles[body] = [
                frozenset(
                    other
                    for other, is_blocking in zip(others, column, strict=True)
                    if is_blocking and other is not self.held
                )
                for column in zip(*rows, strict=True)
            ] or [frozenset()]
        return self._obstacles[body]

    def is_blocked(self, body: Body) -> bool:
        """Whether every grasp candidate of a body is blocked."""
        return all(self.obstacles(body))

    def removals(self, assignment: Sequence[Body | None]) -> Iterator[tuple[int, Body, None]]:
        """Yield the pieces to place on the ground to free the grasp of another piece.

        Args:
            assignment: the body in each slot; these pieces are not picked.

        Yields:
            Number of pieces to remove, the piece to remove first, and None for the ground.
        """
        for body in self.pieces:
            if body not in assignment and body is not self.held:
                removed = self._fewest_removals(body) or ()
                for top in removed:
                    if self.bodies_above[top].isdisjoint(removed):
                        yield len(removed), top, None

    def added_removals(self, move: Move, assignment: Sequence[Body | None]) -> int:
        """Return the number of moves that a move adds, as its piece blocks others.

        Args:
            move: the move.
            assignment: the body in each slot; these pieces are not picked.
        """
        if not self.queries.clears_blocked_pieces:
            return 0
        after, most = self._after(move), 0
        for other in self.pieces:
            if other in assignment or other is move.body or other is self.held:
                continue
            removed = after._fewest_removals(other)
            if removed is None and self._fewest_removals(other) is not None:
                most = len(self.pieces)
            elif removed is not None and move.body in removed:
                most = max(most, len(removed))
        return most + 2 if most else 0  # the piece is removed and placed again

    def _fewest_removals(self, body: Body) -> frozenset[Body] | None:
        """Return the smallest set of pieces whose removal frees a grasp of a body; None if none is.

        Each of them has a grasp that only pieces of the set block.
        """
        found = []
        for obstacles in self.obstacles(body):
            removed = obstacles.union(*(self.bodies_above[other] for other in obstacles))
            if body not in removed and all(
                any(others <= removed for others in self.obstacles(other)) for other in removed
            ):
                found.append(removed)
        return min(found, key=len, default=None)

    def _after(self, move: Move) -> GraspBlocking:
        """Return the blocking after a move; the moved piece itself counts as free to grasp."""
        body, bodies_above = move.body, dict(self.bodies_above)
        for other, above in self.bodies_above.items():
            if other in move.onto or not above.isdisjoint(move.onto):
                bodies_above[other] = above | {body}
        held = None if self.held is body else self.held
        after = GraspBlocking(self.pieces, bodies_above, held, self.queries)
        for other in self.pieces:
            if other is body:
                after._obstacles[other] = [frozenset()]
                continue
            blocks = self.queries.blocks_grasp(other, body, move.position)
            after._obstacles[other] = [
                obstacles | {body} if is_blocking else obstacles - {body}
                for obstacles, is_blocking in zip(self.obstacles(other), blocks, strict=True)
            ]
        return after
