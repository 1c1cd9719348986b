"""Building: the pieces of a blueprint in a world, whether they stand as they should, what is next.

The bodies are matched to the slots by their kind, in whatever way suits the scene best, so that
every question is answered from any state.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cache

import numpy as np

from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.structures.assignment import (
    Assignment,
    SlotAssigner,
    middle,
    read_piece_states,
)
from ba_torchrl.tasks.structures.blocking import GraspBlocking, GraspQueries, Move
from ba_torchrl.tasks.structures.blueprint import UPRIGHT_RAD, Blueprint, Piece, Slot
from ba_torchrl.tasks.structures.free_space import (
    PlacementArea,
    extent_along_m,
    nearest_spot,
    placement_deficit_m,
)

BEARINGS = 16
"""Spots beside a piece are looked for in this many directions of a half turn."""
SITE_POINTS = 7
"""What a structure will take up on the ground is told by this many points along a bridge."""
CROWDED = 10.0
"""What a metre too near is worth in metres of way."""
STUCK = 100
"""What it is worth in detours that the hand can reach what it is to pick."""


class StructurePlanner:
    """The pieces of a blueprint in a world; contacts are those of the last step.

    Args:
        blueprint: what is to be built.
        world: where.
        pieces: the bodies and what each of them is; there may be more than the blueprint needs.
        block_m: edge of a block, the scale of what counts as on top.
        support_ids: PyBullet ids of what the lowest pieces stand on; the floor if None.

    Raises:
        ValueError: there are too few bodies of a kind.
    """

    def __init__(
        self,
        blueprint: Blueprint,
        world: World,
        pieces: Mapping[Body, Piece],
        block_m: float,
        support_ids: frozenset[int] | None = None,
    ) -> None:
        self.blueprint = blueprint
        self.world = world
        self.pieces = dict(pieces)
        self.block_m = block_m
        self.support_ids = frozenset((world.floor,)) if support_ids is None else support_ids
        needed = Counter(slot.piece.kind for slot in blueprint.slots)
        found = Counter(piece.kind for piece in self.pieces.values())
        for kind, count in needed.items():
            if found[kind] < count:
                raise ValueError(f"the blueprint needs {count} of {kind!r}, not {found[kind]}")

    def evaluate(self, held: Body | None = None) -> dict[str, bool]:
        """Return whether the structure stands and no piece of it is held.

        Args:
            held: the body in the gripper.
        """
        assigner = self._assigner(held)
        is_built = any(not assigner.misplaced(found) for found in assigner.assignments())
        return {"is_released": held not in self.pieces, "is_built": is_built}

    def is_built(self, held: Body | None = None) -> bool:
        """Whether every condition of `evaluate` holds.

        Args:
            held: the body in the gripper.
        """
        return all(self.evaluate(held).values())

    def has_tipped(self, held: Body | None = None) -> bool:
        """Whether a piece that must stay upright does not, and is not in the gripper either."""
        return any(
            piece.stays_upright and body is not held and piece.tilt_rad(body) >= UPRIGHT_RAD
            for body, piece in self.pieces.items()
        )

    def next_move(
        self,
        area: PlacementArea,
        held: Body | None = None,
        queries: GraspQueries | None = None,
    ) -> Move | None:
        """Return the move that brings the structure on, or None if it stands.

        What lies where it belongs stays; what is in the way, or on a piece that is needed, goes
        to the ground first, from the top down. So does what keeps the hand from a piece.

        Args:
            area: where on the ground there is room.
            held: what the gripper holds: it is placed before anything else is picked.
            queries: about the gripper; one that needs no room if not given.
        """
        queries = queries or GraspQueries()
        effort = cache(queries.pick_effort_m)
        assigner = self._assigner(held)
        assignments, most = assigner.largest_assignments()
        if most == len(self.blueprint.slots):
            if held in self.pieces:
                return self._to_ground(held, area)
            misplaced = min(map(assigner.misplaced, assignments), key=len)
            return self._to_ground(min(misplaced, key=effort), area) if misplaced else None
        bodies_above = assigner.bodies_above()
        blocking = GraspBlocking(self.pieces, bodies_above, held, queries)
        holds_piece = held in self.pieces
        best: tuple[tuple[int, float], Move | Body] | None = None
        for assignment in assignments:
            choices = [
                *self._choices(assignment, assigner, bodies_above),
                *blocking.removals(assignment),
            ]
            # what is cheap at first sight spares the others a closer look
            for detour, body, number in sorted(
                choices, key=lambda choice: choice[0] + (holds_piece and choice[1] is not held)
            ):
                first = (
                    holds_piece and body is not held
                )  # what is held goes to the ground before that
                detour += first + (STUCK if body is not held and blocking.is_blocked(body) else 0)
                if best is not None and detour > best[0][0]:
                    continue
                move, way = body, 0.0
                if number is not None and not (first and not queries.clears_blocked_pieces):
                    move, crowd_m = self._into_slot(body, number, assignment, area, queries)
                    detour += blocking.added_removals(move, assignment)
                    way = math.dist(assigner.states[body].position[:2], move.position[:2])
                    way += CROWDED * crowd_m
                if first:
                    move, way = held, 0.0
                cost = (detour, way + (0.0 if holds_piece else effort(body)))
                if best is None or cost < best[0]:
                    best = cost, move
        assert best is not None  # the lowest empty slot can always be worked at
        move = best[1]
        return move if isinstance(move, Move) else self._to_ground(move, area)

    # ----------------------------------------------------------------------------------------

    def _assigner(self, held: Body | None) -> SlotAssigner:
        """Return how the pieces lie."""
        states = read_piece_states(self.world, self.pieces, self.support_ids, self.block_m)
        return SlotAssigner(self.blueprint, self.pieces, states, self.block_m, held)

    def _choices(
        self,
        assignment: Assignment,
        assigner: SlotAssigner,
        bodies_above: Mapping[Body, frozenset[Body]],
    ) -> Iterator[tuple[int, Body, int | None]]:
        """Yield what could be done next.

        Yields:
            How many pieces must go to the ground first, the body to move, and the slot that it
            goes to; None for the ground.
        """
        for number, slot in enumerate(self.blueprint.slots):
            partner = self.blueprint.partner(number)
            if assignment[number] is not None or any(assignment[i] is None for i in slot.on):
                continue
            if partner is not None and partner < number and assignment[partner] is None:
                continue
            beside = () if partner is None or assignment[partner] is None else (partner,)
            misplaced = assigner.misplaced(assignment, (*slot.on, *beside))
            for body, piece in self.pieces.items():
                if piece.kind != slot.piece.kind or body in assignment:
                    continue
                others = [stray for stray in misplaced if stray is not body]
                in_the_way = set(others).union(
                    bodies_above[body], *(bodies_above[stray] for stray in others)
                )
                in_the_way -= {body, assigner.held}
                if not in_the_way:
                    yield 0, body, number
                for top in in_the_way:
                    if not any(top in assigner.states[other].below for other in in_the_way):
                        yield len(in_the_way), top, None

    def _into_slot(
        self,
        body: Body,
        number: int,
        assignment: Assignment,
        area: PlacementArea,
        queries: GraspQueries,
    ) -> tuple[Move, float]:
        """Return the move that fills a slot, and by how much its place is too near to others."""
        slots, slot, piece = self.blueprint.slots, self.blueprint.slots[number], self.pieces[body]
        supports = [assignment[i] for i in slot.on]
        partner = self.blueprint.partner(number)
        beside = None if partner is None else assignment[partner]
        bridge = None if partner is None else slots[self.blueprint.bridge_on(number)]
        rest = [other for other in self.pieces if other is not body and other not in assignment]
        if not supports:
            if beside is None:
                return self._to_ground(body, area), 0.0
            return self._beside(body, beside, bridge, area, rest, queries)
        x, y, _ = middle(assignment[i].position for i in self._over(number))
        z = max(vertical_extent(support)[1] for support in supports)
        z += body.position[2] - vertical_extent(body)[0]
        yaw, period = None, piece.yaw_period_rad
        if len(supports) == 2:
            (ax, ay, _), (bx, by, _) = (support.position for support in supports)
            yaw = math.atan2(by - ay, bx - ax) - math.pi / 2
        else:
            support = self.pieces[supports[0]]
            yaw = support.yaw_rad(supports[0])
            if bridge is not None:
                x, y = self._along(body, supports[0], beside, bridge.span.aim_m)
            period = min(period, support.yaw_period_rad)
        if not slot.inherits_yaw:
            yaw = None
        crowd_m = 0.0
        if sum(other is not None for other in assignment) == 1:
            crowd_m = float(queries.site_deficit_m(np.array([[(x, y)]]), rest)[0])
        return Move(body, piece, (x, y, z), yaw, period, tuple(supports)), crowd_m

    def _over(self, number: int) -> tuple[int, ...]:
        """Return the slots over whose middle a piece goes: in a tower, the two beneath it.

        Where these lean, the middle of the upper one alone would bring the tower down.
        """
        slots = self.blueprint.slots
        on = slots[number].over or slots[number].on
        below = slots[on[0]].on if len(on) == 1 else ()
        return (*on, *below) if len(below) == 1 else on

    def _along(
        self, body: Body, support: Body, beside: Body | None, apart_m: float
    ) -> tuple[float, float]:
        """Return where on a long support one of two pieces goes."""
        heading = self.pieces[support].yaw_rad(support) + math.pi / 2
        ux, uy = math.cos(heading), math.sin(heading)
        sx, sy, _ = support.position

        def along(other: Body) -> float:
            x, y, _ = other.position
            return (x - sx) * ux + (y - sy) * uy

        if beside is None:
            place = math.copysign(apart_m / 2, along(body))
        else:
            place = along(beside) - math.copysign(apart_m, along(beside))
        return sx + place * ux, sy + place * uy

    def _beside(
        self,
        body: Body,
        anchor: Body,
        bridge: Slot,
        area: PlacementArea,
        rest: Sequence[Body],
        queries: GraspQueries,
    ) -> tuple[Move, float]:
        """Return the move to the ground beside a piece, and by how much that is too near others.

        Args:
            body: what to move.
            anchor: the piece.
            bridge: the slot of what will lie on both.
            area: where there is room.
            rest: the pieces that are still to be fetched then.
            queries: as for `next_move`.
        """
        piece = self.pieces[body]
        x, y, z = body.position
        center = np.array(anchor.position[:2])
        start = math.atan2(y - center[1], x - center[0])
        if area.line_yaw_rad is None:
            bearings = start + math.pi / BEARINGS * np.arange(2 * BEARINGS)
        else:
            bearings = area.line_yaw_rad + np.array([0.0, math.pi])
        ways = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
        radii = np.full(len(ways), bridge.span.aim_m)
        yaw = None
        if bridge.span.gap_m is not None:
            # it will point at its neighbour the side that the fingers do not close on
            side = piece.grasp_yaws_rad[0] + math.pi / 2
            cos, sin = math.cos(side), math.sin(side)
            far = (body.shape.vertices[:, :2] @ [cos, sin]).max()
            near = (body.shape.vertices[:, :2] @ [-cos, -sin]).max()
            radii = extent_along_m(anchor, ways) + max(far, near) + bridge.span.gap_m
            yaw = -side
        spots = center + radii[:, None] * ways
        others = [other for other in self.pieces if other is not body and other is not anchor]
        cost = placement_deficit_m(spots, body, others, area)
        length = max(
            (
                np.ptp(b.shape.vertices[:, 1])
                for b, p in self.pieces.items()
                if p.kind == bridge.piece.kind
            ),
            default=0.0,
        )
        along = radii[:, None] / 2 + length / 2 * np.linspace(-1.0, 1.0, SITE_POINTS)
        cost = cost + queries.site_deficit_m(center + along[:, :, None] * ways[:, None], rest)
        aways = np.hypot(spots[:, 0] - x, spots[:, 1] - y)
        best = int(np.lexsort((radii + aways, cost.round(6)))[0])
        spot = tuple(spots[best].tolist())
        place = (*spot, area.height_m(spot) + z - vertical_extent(body)[0])
        heading = None if yaw is None else float(yaw + bearings[best])
        return Move(body, piece, place, heading, piece.yaw_period_rad, ()), float(cost[best])

    def _to_ground(self, body: Body, area: PlacementArea) -> Move:
        """Return the move to a spot on the ground with room around it, the nearest such."""
        others = [other for other in self.pieces if other is not body]
        place = nearest_spot(body, others, area)
        return Move(body, self.pieces[body], place, None, self.pieces[body].yaw_period_rad, ())
