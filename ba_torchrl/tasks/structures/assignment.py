"""Standing: how the pieces of a blueprint lie, and which of them fills which slot."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.contacts import CONTACT_DISTANCE_M, contacts
from ba_torchrl.sim.geometry import Vector
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.structures.blueprint import UPRIGHT_RAD, Blueprint, Piece
from ba_torchrl.tasks.structures.free_space import extent_along_m

LYING_COSINE = 0.5
"""A piece lies on another if the surfaces that touch are within 60 degrees of level."""


class PieceState(NamedTuple):
    """A piece as it lies now."""

    position: Vector
    tilt_rad: float
    on_ground: bool
    below: frozenset[Body]
    """The pieces that it rests on."""


Assignment = tuple[Body | None, ...]
"""The body in each slot."""


def read_piece_states(
    world: World, pieces: Mapping[Body, Piece], ground: frozenset[int], block_m: float
) -> dict[Body, PieceState]:
    """Return how every piece lies; contacts are those of the last step.

    Args:
        world: holds them.
        pieces: what each body is.
        ground: PyBullet ids of what the lowest pieces stand on.
        block_m: edge of a block, the measure of what counts as on top.
    """
    by_id = {body.id: body for body in pieces}
    heights = {body: body.position[2] for body in pieces}
    states = {}
    for body, piece in pieces.items():
        touched, below = set(), set()
        for point in contacts(world.client, body.id):
            if point.distance_m >= CONTACT_DISTANCE_M:
                continue
            touched.add(point.other_id)
            other = by_id.get(point.other_id)
            if (
                other is not None
                and point.normal[2] > LYING_COSINE
                and heights[body] - heights[other] >= block_m / 2
            ):
                below.add(other)
        states[body] = PieceState(
            body.position,
            piece.tilt_rad(body),
            not ground.isdisjoint(touched),
            frozenset(below),
        )
    return states


class SlotAssigner:
    """The pieces as they lie now, matched to the slots of a blueprint by their kind.

    Args:
        blueprint: what is to be built.
        pieces: what each body is.
        states: how each lies.
        block_m: edge of a block, the measure of what counts as on top.
        held: what the gripper holds.
    """

    def __init__(
        self,
        blueprint: Blueprint,
        pieces: Mapping[Body, Piece],
        states: Mapping[Body, PieceState],
        block_m: float,
        held: Body | None,
    ) -> None:
        self.blueprint = blueprint
        self.pieces = pieces
        self.states = states
        self.block_m = block_m
        self.held = held

    def assignments(self) -> Iterator[Assignment]:
        """Yield every way to see a body in each of the slots."""

        def fill(assignment: Assignment) -> Iterator[Assignment]:
            if len(assignment) == len(self.blueprint.slots):
                yield assignment
                return
            for body in self._candidates(assignment):
                yield from fill((*assignment, body))

        return fill(())

    def largest_assignments(self) -> tuple[list[Assignment], int]:
        """Return all ways to see bodies in as many slots as possible, and how many these are."""
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
        """Return what lies on the bodies in some slots and does not belong there.

        Args:
            assignment: the body in each slot.
            numbers: the slots; those that must stay free if not given.
        """
        slots = self.blueprint.slots
        if numbers is None:
            numbers = [i for i, slot in enumerate(slots) if slot.stays_free]
        misplaced = []
        for number in numbers:
            own = {assignment[i] for i, slot in enumerate(slots) if number in slot.on}
            misplaced += [
                body
                for body, view in self.states.items()
                if assignment[number] in view.below and body not in own
            ]
        return misplaced

    def bodies_above(self) -> dict[Body, frozenset[Body]]:
        """Return all that lies on each piece, right on it or on what does."""
        bodies_above: dict[Body, frozenset[Body]] = {}
        # from the top down: what lies on a piece is higher than it
        for body in sorted(self.pieces, key=lambda piece: -self.states[piece].position[2]):
            upon = {
                b for b, view in self.states.items() if b is not self.held and body in view.below
            }
            bodies_above[body] = frozenset(upon.union(*(bodies_above[b] for b in upon)))
        return bodies_above

    def _candidates(self, assignment: Assignment) -> Iterator[Body]:
        """Yield the bodies that lie as they must for the next slot."""
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
        """Whether a body lies as it must to fill a slot."""
        slot, view = self.blueprint.slots[number], self.states[body]
        supports = [assignment[i] for i in slot.on]
        if view.tilt_rad >= UPRIGHT_RAD:
            return False
        partner = self.blueprint.partner(number)
        if supports:
            if view.on_ground or not view.below.issuperset(supports):
                return False
        elif not view.on_ground or view.below:
            return False
        if partner is not None:
            return partner > number or self._is_pair(body, number, partner, assignment)
        if not supports:
            return True
        over = [assignment[i] for i in slot.over or slot.on]
        if None in over:
            return False
        dx, dy = (
            view.position[i] - middle(self.states[o].position for o in over)[i] for i in (0, 1)
        )
        if len(over) == 1:
            return max(abs(dx), abs(dy)) <= self.block_m / 2
        return math.hypot(dx, dy) < self.block_m

    def _is_pair(self, body: Body, number: int, partner: int, assignment: Assignment) -> bool:
        """Whether a body stands right beside the one in a slot for a bridge to lie on both."""
        other = assignment[partner]
        if other is None:
            return False
        on = self.blueprint.slots[number].on
        here, there = self.states[body].position, self.states[other].position
        if on:
            below = self.states[assignment[on[0]]].position
            if math.dist(middle((here, there))[:2], below[:2]) >= self.block_m:
                return False
        bridge = self.blueprint.slots[self.blueprint.bridge_on(number)]
        apart = math.dist(here[:2], there[:2])
        if bridge.span.gap_m is not None:
            way = (np.array(there[:2]) - here[:2]) / max(apart, 1e-9)
            apart -= float(
                extent_along_m(body, way[None])[0] + extent_along_m(other, -way[None])[0]
            )
        if bridge.span.least_m <= apart <= bridge.span.most_m:
            return True
        return any(
            piece.kind == bridge.piece.kind
            and self.states[candidate].below.issuperset((body, other))
            for candidate, piece in self.pieces.items()
        )


def middle(points: Iterable[Vector]) -> Vector:
    """Return the mean of some points."""
    return tuple(sum(values) / len(values) for values in zip(*points, strict=True))
