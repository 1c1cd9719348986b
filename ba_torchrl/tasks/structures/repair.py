"""Repair: the pieces in the way of a structure, which are placed on the ground before it grows.

A piece is in the way if it rests where another belongs, or if it blocks the grasp of one that is
needed. Pieces are removed from the top down.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from ba_torchrl.sim.bodies import Body
from ba_torchrl.tasks.structures.assignment import Assignment, SlotAssigner
from ba_torchrl.tasks.structures.bridges import beside_supports
from ba_torchrl.tasks.structures.moves import Choice, Grasps, Move


class Repair:
    """What is in the way in the present scene."""

    def __init__(self, assigner: SlotAssigner, grasps: Grasps) -> None:
        self.assigner = assigner
        self.pieces = assigner.pieces
        self.held = assigner.held
        self.grasps = grasps
        self._above = _bodies_above(assigner)
        self._blocking = _GraspBlocking(self.pieces, self._above, self.held, grasps)

    def in_the_way(self, body: Body, number: int, assignment: Assignment) -> set[Body]:
        """Return the pieces to remove before a body can fill a slot whose supports are filled."""
        blueprint = self.assigner.blueprint
        on, (_, partner) = blueprint.slots[number].on, blueprint.bridge_on(number)
        filled = on if partner is None or assignment[partner] is None else (*on, partner)
        misplaced = self.assigner.misplaced(assignment, filled)
        others = [other for other in misplaced if other is not body]
        loose = [b for b in self.pieces if b not in assignment and b is not self.held]
        others += beside_supports(body, [assignment[i] for i in on], loose)
        removed = set(others).union(self._above[body], *(self._above[other] for other in others))
        return removed - {body, self.held}

    def removals(self, removed: Collection[Body]) -> Iterator[Choice]:
        """Yield the removal of each of some pieces on which no other of them rests."""
        states = self.assigner.states
        for top in self.pieces:
            if top in removed and not any(top in states[other].supports for other in removed):
                yield Choice(len(removed), top)

    def grasp_removals(self, assignment: Assignment) -> Iterator[Choice]:
        """Yield the removals that free the grasp of another piece.

        Args:
            assignment: the body in each slot; these pieces are not picked.
        """
        for body in self.pieces:
            if body not in assignment and body is not self.held:
                yield from self.removals(self._blocking.fewest_removals(body) or ())

    def is_blocked(self, body: Body) -> bool:
        """Whether other pieces block all grasps of a body."""
        return all(self._blocking.obstacles(body))

    def added_moves(self, move: Move, assignment: Assignment) -> int:
        """Return the number of moves that a move adds, as its piece blocks others.

        Args:
            assignment: the body in each slot; these pieces are not picked.
        """
        if not self.grasps.clears_blocked_pieces:
            return 0
        after, most = self._blocking.after(move), 0
        for other in self.pieces:
            if other in assignment or other is move.body or other is self.held:
                continue
            removed = after.fewest_removals(other)
            if removed is None and self._blocking.fewest_removals(other) is not None:
                most = len(self.pieces)
            elif removed is not None and move.body in removed:
                most = max(most, len(removed))
        return most + 2 if most else 0  # the piece is removed and placed again


@dataclass
class _GraspBlocking:
    """Which pieces block the grasp of another piece."""

    pieces: Iterable[Body]
    above: Mapping[Body, frozenset[Body]]
    """For each body all that it supports, directly or through others."""
    held: Body | None
    """The body in the gripper; it blocks no grasp."""
    grasps: Grasps
    _obstacles: dict[Body, list[frozenset[Body]]] = field(default_factory=dict)

    def obstacles(self, body: Body) -> list[frozenset[Body]]:
        """Return for each grasp of a body the pieces that block it."""
        if not self.grasps.clears_blocked_pieces:
            return [frozenset()]
        if body not in self._obstacles:
            others = [other for other in self.pieces if other is not body]
            rows = [self.grasps.blocks_grasp(body, other, None) for other in others]
            self._obstacles[body] = [
                frozenset(
                    other
                    for other, is_blocking in zip(others, column, strict=True)
                    if is_blocking and other is not self.held
                )
                for column in zip(*rows, strict=True)
            ] or [frozenset()]
        return self._obstacles[body]

    def fewest_removals(self, body: Body) -> frozenset[Body] | None:
        """Return the smallest set of pieces whose removal frees a grasp of a body; None if none is.

        Each of them has a grasp that only pieces of the set block.
        """
        found = []
        for obstacles in self.obstacles(body):
            removed = obstacles.union(*(self.above[other] for other in obstacles))
            if body not in removed and all(
                any(others <= removed for others in self.obstacles(other)) for other in removed
            ):
                found.append(removed)
        return min(found, key=len, default=None)

    def after(self, move: Move) -> _GraspBlocking:
        """Return the blocking after a move; the moved piece itself counts as free to grasp."""
        body, above = move.body, dict(self.above)
        for other, bodies in self.above.items():
            if other in move.onto or not bodies.isdisjoint(move.onto):
                above[other] = bodies | {body}
        held = None if self.held is body else self.held
        after = _GraspBlocking(self.pieces, above, held, self.grasps)
        for other in self.pieces:
            if other is body:
                after._obstacles[other] = [frozenset()]
                continue
            blocks = self.grasps.blocks_grasp(other, body, move.position)
            after._obstacles[other] = [
                obstacles | {body} if is_blocking else obstacles - {body}
                for obstacles, is_blocking in zip(self.obstacles(other), blocks, strict=True)
            ]
        return after


def _bodies_above(assigner: SlotAssigner) -> dict[Body, frozenset[Body]]:
    """Return for each piece all pieces that it supports, directly or through others."""
    states = assigner.states
    above: dict[Body, frozenset[Body]] = {}
    # from the top down: a piece is higher than its supports
    for body in sorted(assigner.pieces, key=lambda piece: -piece.position[2]):
        supported = {
            other
            for other, state in states.items()
            if other is not assigner.held and body in state.supports
        }
        above[body] = frozenset(supported.union(*(above[other] for other in supported)))
    return above
