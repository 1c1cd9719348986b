"""The states of the pieces of a blueprint, and their assignment to its slots.

Bodies are matched to slots by their kind, so the assignments depend on the present scene only.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.contacts import CONTACT_DISTANCE_M, contacts
from ba_torchrl.sim.geometry import Vector
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.structures.blueprint import UPRIGHT_RAD, Blueprint, Piece, Slot
from ba_torchrl.tasks.structures.free_space import extent_along_m

SUPPORT_COSINE = 0.5
"""A contact supports a piece if its normal is within 60 degrees of the vertical."""


class PieceState(NamedTuple):
    """Tilt and supports of a piece."""

    tilt_rad: float
    on_ground: bool
    """Whether it touches the ground."""
    on_base: bool
    """Whether ground on which a structure may stand supports it."""
    supports: frozenset[Body]
    """The pieces that it rests on."""


Assignment = tuple[Body | None, ...]
"""The body in each slot; None for an empty slot."""


def read_piece_states(
    world: World,
    pieces: Mapping[Body, Piece],
    ground: frozenset[int],
    base: frozenset[int],
    block_m: float,
) -> dict[Body, PieceState]:
    """Return the state of every piece, with the contacts of the last physics step.

    Args:
        ground: PyBullet ids of the bodies that form the ground.
        base: ids among ``ground`` on which a structure may stand.
        block_m: edge of a block. A support is at least half of it lower than the piece.
    """
    by_id = {body.id: body for body in pieces}
    heights = {body: body.position[2] for body in pieces}
    states = {}
    for body, piece in pieces.items():
        touched, below, supports = set(), set(), set()
        for point in contacts(world.client, body.id):
            if point.distance_m >= CONTACT_DISTANCE_M:
                continue
            touched.add(point.other_id)
            if point.normal[2] <= SUPPORT_COSINE:
                continue
            below.add(point.other_id)
            other = by_id.get(point.other_id)
            if other is not None and heights[body] - heights[other] >= block_m / 2:
                supports.add(other)
        states[body] = PieceState(
            piece.tilt_rad(body),
            not ground.isdisjoint(touched),
            not base.isdisjoint(below),
            frozenset(supports),
        )
    return states


@dataclass(frozen=True)
class SlotAssigner:
    """Finds the assignments of the pieces, in their present states, to the slots of a blueprint."""

    blueprint: Blueprint
    pieces: Mapping[Body, Piece]
    states: Mapping[Body, PieceState]
    block_m: float
    """Edge of a block, which bounds how far a piece may be off the centre of its slot."""
    held: Body | None
    """The body in the gripper; it fills no slot."""

    def evaluate(self) -> dict[str, bool]:
        """Return whether the structure stands and whether no piece is held."""
        assignments, most = self.largest_assignments()
        is_built = most == len(self.blueprint.slots) and not all(map(self.misplaced, assignments))
        return {"is_released": self.held not in self.pieces, "is_built": is_built}

    def placed(self) -> set[Body]:
        """Return the pieces that are in slots in every largest assignment."""
        return set.intersection(*map(set, self.largest_assignments()[0]))

    def largest_assignments(self) -> tuple[list[Assignment], int]:
        """Return all assignments that fill as many slots as possible, and that number of slots."""
        count = len(self.blueprint.slots)
        found: list[Assignment] = []
        most = 0

        def fill(assignment: Assignment, filled: int) -> None:
            nonlocal found, most
            if filled + count - len(assignment) < most:
                return
            if len(assignment) == count:
                if filled > most:
                    found, most = [], filled
                found.append(assignment)
                return
            for body in self._candidates(assignment):
                fill((*assignment, body), filled + 1)
            fill((*assignment, None), filled)

        fill((), 0)
        return found, most

    def misplaced(self, assignment: Assignment, numbers: Sequence[int] | None = None) -> list[Body]:
        """Return the pieces that rest on bodies in slots where the blueprint places none of them.

        Args:
            numbers: numbers of the slots to check; by default those that must stay clear.
        """
        slots = self.blueprint.slots
        if numbers is None:
            numbers = [i for i, slot in enumerate(slots) if slot.stays_clear]
        misplaced = []
        for number in numbers:
            belonging = {assignment[i] for i, slot in enumerate(slots) if number in slot.on}
            misplaced += [
                body
                for body, state in self.states.items()
                if assignment[number] in state.supports and body not in belonging
            ]
        return misplaced

    def _candidates(self, assignment: Assignment) -> Iterator[Body]:
        """Yield the bodies that can fill the next slot of a partial assignment."""
        number = len(assignment)
        slot = self.blueprint.slots[number]
        if any(assignment[i] is None for i in slot.on):
            return
        for body, piece in self.pieces.items():
            if (
                piece.kind == slot.piece.kind
                and body is not self.held
                and body not in assignment
                and self._fits(body, number, assignment)
            ):
                yield body

    def _fits(self, body: Body, number: int, assignment: Assignment) -> bool:
        """Whether a body is where a piece in a slot would be."""
        slot, state = self.blueprint.slots[number], self.states[body]
        supports = [assignment[i] for i in slot.on]
        if state.tilt_rad >= UPRIGHT_RAD:
            return False
        bridge, partner = self.blueprint.bridge_on(number)
        if supports:
            if state.on_ground or not state.supports.issuperset(supports):
                return False
        elif not state.on_base or state.supports:
            return False
        if bridge is not None:
            return partner > number or self._is_pair(body, assignment[partner], bridge, supports)
        if not supports:
            return True
        below = [assignment[i] for i in slot.centered_over or slot.on]
        if None in below:
            return False
        center = mean_position(other.position for other in below)
        dx, dy = (body.position[i] - center[i] for i in (0, 1))
        if len(below) == 1:
            return max(abs(dx), abs(dy)) <= self.block_m / 2
        return math.hypot(dx, dy) < self.block_m

    def _is_pair(
        self, body: Body, other: Body | None, bridge: Slot, supports: Sequence[Body]
    ) -> bool:
        """Whether two bodies, on the same supports, are where they can support a bridge."""
        if other is None:
            return False
        if supports:
            middle = mean_position((body.position, other.position))
            if math.dist(middle[:2], supports[0].position[:2]) >= self.block_m:
                return False
        if self.span_error_m(bridge, body, other) == 0:
            return True
        return any(
            piece.kind == bridge.piece.kind
            and self.states[candidate].supports.issuperset((body, other))
            for candidate, piece in self.pieces.items()
        )

    def span_error_m(self, bridge: Slot, body: Body, other: Body) -> float:
        """Return by how much the distance of two pieces is outside the span of a bridge."""
        first, second = body.position, other.position
        distance = math.dist(first[:2], second[:2])
        if bridge.span.gap_m is not None:
            direction = (np.array(second[:2]) - first[:2]) / max(distance, 1e-9)
            distance -= float(
                extent_along_m(body, direction[None])[0]
                + extent_along_m(other, -direction[None])[0]
            )
        return max(bridge.span.least_m - distance, distance - bridge.span.most_m, 0.0)


def mean_position(points: Iterable[Vector]) -> Vector:
    """Return the mean of points."""
    return tuple(sum(values) / len(values) for values in zip(*points, strict=True))
