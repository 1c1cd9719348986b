"""Planner of structures: which piece to move next, and where."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body, footprint_radius_m, vertical_extent
from ba_torchrl.tasks.structures.assignment import Assignment, SlotAssigner, mean_position
from ba_torchrl.tasks.structures.bridges import bridge_yaw_rad, point_on_support, site_beside
from ba_torchrl.tasks.structures.free_space import PlacementArea, nearest_free_site
from ba_torchrl.tasks.structures.moves import DEFICIT_WEIGHT, Choice, Grasps, Move
from ba_torchrl.tasks.structures.repair import Repair

BLOCKED_MOVES = 100
"""Cost, in moves, of picking a piece whose grasps are all blocked."""


def next_move(assigner: SlotAssigner, area: PlacementArea, grasps: Grasps) -> Move | None:
    """Return the next move towards the structure; None if it stands.

    Pieces in their slots stay. What is in the way of the next piece is placed on the ground first;
    see `Repair`. A held piece is placed before another is picked. Of the assignments, that with the
    fewest moves is followed.

    Args:
        area: where pieces may be placed on the ground.
    """
    return next(iter(next_moves(assigner, area, grasps)), None)


def next_moves(assigner: SlotAssigner, area: PlacementArea, grasps: Grasps) -> list[Move]:
    """Return the next move and those that are as good, of one for each piece of the same kind, or
    of the held piece for each slot; none if the structure stands.

    They lead to the structure in as few moves as the first, with as much room, and may be farther.

    Args:
        area: where pieces may be placed on the ground.
    """
    return _Planner(assigner, area, grasps).next_moves()


class _Option(NamedTuple):
    """A choice with its cost: of two, that with fewer moves is better, then the nearer one."""

    moves: int
    """Moves besides those that fill the slots."""
    distance_m: float
    body: Body
    move: Move | None
    """Its move to a slot; None for the ground."""


class _Planner:
    """The moves of one decision; arguments as for `next_move`."""

    def __init__(self, assigner: SlotAssigner, area: PlacementArea, grasps: Grasps) -> None:
        self.assigner = assigner
        self.area = area
        self.grasps = grasps
        self.pieces = assigner.pieces
        self.slots = assigner.blueprint.slots
        self.held = assigner.held if assigner.held in assigner.pieces else None
        self.repair = Repair(assigner, grasps)
        self.pick_cost_m = cache(grasps.pick_cost_m)

    def next_moves(self) -> list[Move]:
        """Return the next move and its equals; none if the structure stands."""
        assignments, filled = self.assigner.largest_assignments()
        if filled == len(self.slots):
            last = self._last_move(assignments)
            return [] if last is None else [last]
        best: _Option | None = None
        options: list[_Option] = []
        for assignment in assignments:
            choices = [*self._choices(assignment), *self.repair.grasp_removals(assignment)]
            # cheap lower bounds first, so that most of the others are skipped
            for choice in sorted(choices, key=self._least_moves):
                moves = self._least_moves(choice)
                if choice.body is not self.held and self.repair.is_blocked(choice.body):
                    moves += BLOCKED_MOVES
                if best is None or moves <= best.moves:
                    options.append(option := self._option(choice, moves, assignment))
                    best = option if best is None or option[:2] < best[:2] else best
        assert best is not None  # the lowest empty slot always has a choice
        if best.move is None:
            return [self._to_ground(best.body)]
        equal = [best]
        for option in sorted(options, key=lambda option: option.distance_m):
            if (
                option is not best
                and self._is_equal(option, best)
                and not any(self._is_same(option, other) for other in equal)
            ):
                equal.append(option)
        return [option.move for option in equal]

    def _is_equal(self, option: _Option, best: _Option) -> bool:
        """Whether an option is as good as the best one but for the distance."""
        if option.moves != best.moves or option.move is None:
            return False
        if self.pieces[option.body].kind != self.pieces[best.body].kind:
            return False
        has_room = option.move.deficit_m <= best.move.deficit_m
        if self.held is not None:
            return has_room
        return has_room and self.pick_cost_m(option.body) <= self.pick_cost_m(best.body)

    def _is_same(self, option: _Option, other: _Option) -> bool:
        """Whether two options pick the same piece, or place the held one at the same position."""
        if self.held is None:
            return option.body is other.body
        return option.move.position == other.move.position

    def _last_move(self, assignments: Sequence[Assignment]) -> Move | None:
        """Return the move of a piece that is left over when all slots are filled."""
        if self.held is not None:
            return self._to_ground(self.held)
        misplaced = min(map(self.assigner.misplaced, assignments), key=len)
        return self._to_ground(min(misplaced, key=self.pick_cost_m)) if misplaced else None

    def _choices(self, assignment: Assignment) -> Iterator[Choice]:
        """Yield the moves that fill an empty slot, or remove a piece so that one can be filled."""
        for number, slot in enumerate(self.slots):
            _, partner = self.assigner.blueprint.bridge_on(number)
            if assignment[number] is not None or any(assignment[i] is None for i in slot.on):
                continue
            if partner is not None and partner < number and assignment[partner] is None:
                continue
            for body, piece in self.pieces.items():
                if piece.kind != slot.piece.kind or body in assignment:
                    continue
                removed = self.repair.in_the_way(body, number, assignment)
                if removed:
                    yield from self.repair.removals(removed)
                else:
                    yield Choice(0, body, number)

    def _least_moves(self, choice: Choice) -> int:
        return choice.removals + self._places_held_first(choice)

    def _places_held_first(self, choice: Choice) -> bool:
        """Whether another held piece is placed on the ground before this choice."""
        return self.held is not None and choice.body is not self.held

    def _option(self, choice: Choice, moves: int, assignment: Assignment) -> _Option:
        """Return a choice with its cost, where ``moves`` includes no moves that it adds."""
        body, places_held = choice.body, self._places_held_first(choice)
        move, distance_m = None, 0.0
        if choice.slot is not None and (self.grasps.clears_blocked_pieces or not places_held):
            move = self._to_slot(body, choice.slot, assignment)
            moves += self.repair.added_moves(move, assignment)
            distance_m = math.dist(body.position[:2], move.position[:2])
            distance_m += DEFICIT_WEIGHT * move.deficit_m
        if places_held:
            return _Option(moves, 0.0, self.held, None)
        if self.held is None:
            distance_m += self.pick_cost_m(body)
        return _Option(moves, distance_m, body, move)

    def _to_slot(self, body: Body, number: int, assignment: Assignment) -> Move:
        """Return the move of a body to a slot."""
        slot, piece = self.slots[number], self.pieces[body]
        supports = [assignment[i] for i in slot.on]
        bridge, partner = self.assigner.blueprint.bridge_on(number)
        neighbor = None if partner is None else assignment[partner]
        rest = [other for other in self.pieces if other is not body and other not in assignment]
        if not supports:
            if neighbor is None:
                return self._to_ground(body, in_structure=True)
            site = site_beside(
                body,
                neighbor,
                bridge,
                pieces=self.pieces,
                rest=rest,
                area=self.area,
                grasps=self.grasps,
            )
            return self._on_ground(body, site.xy, site.yaw_rad)._replace(deficit_m=site.deficit_m)
        x, y, _ = mean_position(assignment[i].position for i in self._centering_slots(number))
        z = max(vertical_extent(support)[1] for support in supports) + self.grasps.rise_m(body)
        period = piece.yaw_period_rad
        if len(supports) == 2:
            yaw = bridge_yaw_rad(supports)
        else:
            support = self.pieces[supports[0]]
            yaw = support.yaw_rad(supports[0])
            if bridge is not None:
                x, y = point_on_support(body, supports[0], yaw, neighbor, bridge)
            period = min(period, support.yaw_period_rad)
        deficit_m = 0.0
        if sum(other is not None for other in assignment) == 1:
            deficit_m = float(self.grasps.site_deficit_m(np.array([[(x, y)]]), rest)[0])
        return Move(
            body,
            piece,
            (x, y, z),
            yaw if slot.inherits_yaw else None,
            period,
            onto=tuple(supports),
            deficit_m=deficit_m,
        )

    def _centering_slots(self, number: int) -> tuple[int, ...]:
        """Return the slots over whose mean position a piece is placed; in a tower, the two below.

        Centred over the upper one only, a piece would tip over a tower that leans.
        """
        on = self.slots[number].centered_over or self.slots[number].on
        below = self.slots[on[0]].on if len(on) == 1 else ()
        return (*on, *below) if len(below) == 1 else on

    def _to_ground(self, body: Body, *, in_structure: bool = False) -> Move:
        """Return the move of a body to the nearest free site on the ground.

        Args:
            in_structure: whether the body is the base of the structure, instead of placed aside.
        """
        others = [other for other in self.pieces if other is not body]
        site = nearest_free_site(body, others, self.area, in_structure=in_structure)
        heading = self.area.building.heading_rad if in_structure else None
        yaw = None
        if heading is not None:
            yaw = heading + math.pi / 2 - self.pieces[body].grasp_yaws_rad[0]
        return self._on_ground(body, site, yaw)

    def _on_ground(self, body: Body, site: tuple[float, float], yaw_rad: float | None) -> Move:
        """Return the move of a body to a site of the ground."""
        piece = self.pieces[body]
        origin = self.area.terrain.origin_pose(
            site, self.grasps.rise_m(body), footprint_radius_m(body)
        )
        period = piece.yaw_period_rad
        return Move(body, piece, origin.position, yaw_rad, period, surface=origin.orientation)
