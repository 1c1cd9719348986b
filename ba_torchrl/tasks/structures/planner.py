"""Planner of structures: whether the structure stands, and which piece to move next and where.

Bodies are matched to slots by their kind, in the assignment that needs the fewest moves, so both
answers depend on the present scene only.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cache

import numpy as np

from ba_torchrl.sim.bodies import Body, footprint_radius_m, vertical_extent
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.structures.assignment import (
    Assignment,
    SlotAssigner,
    mean_position,
    read_piece_states,
)
from ba_torchrl.tasks.structures.blocking import GraspBlocking, GraspQueries, Move
from ba_torchrl.tasks.structures.blueprint import UPRIGHT_RAD, Blueprint, Piece, Slot
from ba_torchrl.tasks.structures.free_space import (
    PlacementArea,
    beside_supports,
    extent_along_m,
    nearest_free_site,
    placement_deficit_m,
)

BEARINGS = 16
"""Directions per half turn in which sites beside a piece are compared."""
SITE_POINTS = 7
"""Points along a bridge that represent the footprint of a structure."""
DEFICIT_WEIGHT = 10.0
"""Cost of a metre of missing clearance, as a multiple of the cost of a metre of distance."""
BLOCKED_MOVES = 100
"""Cost, in moves, of picking a piece whose grasps are all blocked."""


class StructurePlanner:
    """Compares the pieces in a world with a blueprint; contacts are those of the last step.

    Args:
        blueprint: the structure.
        world: the world of the bodies.
        pieces: the kind of each body; there may be more bodies than slots.
        block_m: edge of a block, the scale of the tolerances.
        support_ids: PyBullet ids of the bodies that form the ground.
        base_ids: those of them on which a structure may stand; by default all.

    Raises:
        ValueError: there are too few bodies of a kind.
    """

    def __init__(
        self,
        blueprint: Blueprint,
        world: World,
        pieces: Mapping[Body, Piece],
        block_m: float,
        support_ids: frozenset[int],
        base_ids: frozenset[int] | None = None,
    ) -> None:
        self.blueprint = blueprint
        self.world = world
        self.pieces = dict(pieces)
        self.block_m = block_m
        self.support_ids = support_ids
        self.base_ids = support_ids if base_ids is None else base_ids
        needed = Counter(slot.piece.kind for slot in blueprint.slots)
        found = Counter(piece.kind for piece in self.pieces.values())
        for kind, count in needed.items():
            if found[kind] < count:
                raise ValueError(f"the blueprint needs {count} of {kind!r}, not {found[kind]}")

    def evaluate(self, held: Body | None = None) -> dict[str, bool]:
        """Return whether the structure stands and whether no piece is held.

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

    def has_tipped(self, held: Body | None = None, tipped_rad: float = UPRIGHT_RAD) -> bool:
        """Whether a piece that must stay upright has tipped over and is not held.

        Args:
            held: the body in the gripper.
            tipped_rad: tilt of a piece that has tipped over.
        """
        return any(
            piece.stays_upright and body is not held and piece.tilt_rad(body) >= tipped_rad
            for body, piece in self.pieces.items()
        )

    def placed(self) -> set[Body]:
        """Return the pieces that are in slots in every largest assignment; no piece is held."""
        assignments, _ = self._assigner(None).largest_assignments()
        return set.intersection(*map(set, assignments))

    def next_move(
        self,
        area: PlacementArea,
        held: Body | None = None,
        queries: GraspQueries | None = None,
    ) -> Move | None:
        """Return the next move towards the structure; None if it stands.

        Pieces in their slots stay. Pieces that rest on a slot or on a piece that is needed next,
        and pieces that block its grasp, are placed on the ground first, from the top down.

        Args:
            area: where pieces may be placed on the ground.
            held: the body in the gripper; a held piece is placed before another is picked.
            queries: answers about the gripper; by default every grasp is free.
        """
        queries = queries or GraspQueries()
        pick_cost_m = cache(queries.pick_cost_m)
        assigner = self._assigner(held)
        assignments, most = assigner.largest_assignments()
        if most == len(self.blueprint.slots):
            if held in self.pieces:
                return self._to_ground(held, area, queries)
            misplaced = min(map(assigner.misplaced, assignments), key=len)
            if not misplaced:
                return None
            return self._to_ground(min(misplaced, key=pick_cost_m), area, queries)
        bodies_above = assigner.bodies_above()
        blocking = GraspBlocking(self.pieces, bodies_above, held, queries)
        holds_piece = held in self.pieces
        best: tuple[tuple[int, float], Move | Body] | None = None
        for assignment in assignments:
            choices = [
                *self._choices(assignment, assigner, bodies_above),
                *blocking.removals(assignment),
            ]
            # cheap lower bounds first, so that most of the others are skipped
            for extra_moves, body, number in sorted(
                choices, key=lambda choice: choice[0] + (holds_piece and choice[1] is not held)
            ):
                # another held piece is placed on the ground before this choice
                places_held = holds_piece and body is not held
                extra_moves += places_held
                if body is not held and blocking.is_blocked(body):
                    extra_moves += BLOCKED_MOVES
                if best is not None and extra_moves > best[0][0]:
                    continue
                move, distance_m = body, 0.0
                if number is not None and not (places_held and not queries.clears_blocked_pieces):
                    move, deficit_m = self._to_slot(body, number, assignment, area, queries)
                    extra_moves += blocking.added_removals(move, assignment)
                    distance_m = math.dist(assigner.states[body].position[:2], move.position[:2])
                    distance_m += DEFICIT_WEIGHT * deficit_m
                if places_held:
                    move, distance_m = held, 0.0
                cost = (extra_moves, distance_m + (0.0 if holds_piece else pick_cost_m(body)))
                if best is None or cost < best[0]:
                    best = cost, move
        assert best is not None  # the lowest empty slot always has a choice
        move = best[1]
        return move if isinstance(move, Move) else self._to_ground(move, area, queries)

    # ----------------------------------------------------------------------------------------

    def _assigner(self, held: Body | None) -> SlotAssigner:
        """Return the assigner for the present states of the pieces."""
        states = read_piece_states(
            self.world, self.pieces, self.support_ids, self.base_ids, self.block_m
        )
        return SlotAssigner(self.blueprint, self.pieces, states, self.block_m, held)

    def _choices(
        self,
        assignment: Assignment,
        assigner: SlotAssigner,
        bodies_above: Mapping[Body, frozenset[Body]],
    ) -> Iterator[tuple[int, Body, int | None]]:
        """Yield the moves that fill an empty slot, or remove a piece so that one can be filled.

        Yields:
            Number of pieces to place on the ground first, the body to move, and the number of its
            slot; None for the ground.
        """
        for number, slot in enumerate(self.blueprint.slots):
            partner = self.blueprint.partner(number)
            if assignment[number] is not None or any(assignment[i] is None for i in slot.on):
                continue
            if partner is not None and partner < number and assignment[partner] is None:
                continue
            filled_partner = () if partner is None or assignment[partner] is None else (partner,)
            misplaced = assigner.misplaced(assignment, (*slot.on, *filled_partner))
            for body, piece in self.pieces.items():
                if piece.kind != slot.piece.kind or body in assignment:
                    continue
                others = [other for other in misplaced if other is not body]
                supports = [assignment[i] for i in slot.on]
                loose = [b for b in self.pieces if b not in assignment and b is not assigner.held]
                others += beside_supports(body, supports, loose)
                removed = set(others).union(
                    bodies_above[body], *(bodies_above[other] for other in others)
                )
                removed -= {body, assigner.held}
                if not removed:
                    yield 0, body, number
                for top in removed:
                    if not any(top in assigner.states[other].supports for other in removed):
                        yield len(removed), top, None

    def _to_slot(
        self,
        body: Body,
        number: int,
        assignment: Assignment,
        area: PlacementArea,
        queries: GraspQueries,
    ) -> tuple[Move, float]:
        """Return the move of a body to a slot, and the clearance that its position lacks, metres.

        Args:
            body: the body to move.
            number: number of the slot.
            assignment: the body in each slot.
            area: where pieces may be placed on the ground.
            queries: answers about the gripper.
        """
        slots, slot, piece = self.blueprint.slots, self.blueprint.slots[number], self.pieces[body]
        supports = [assignment[i] for i in slot.on]
        partner = self.blueprint.partner(number)
        neighbor = None if partner is None else assignment[partner]
        bridge = None if partner is None else slots[self.blueprint.bridge_on(number)]
        rest = [other for other in self.pieces if other is not body and other not in assignment]
        if not supports:
            if neighbor is None:
                return self._to_ground(body, area, queries, in_structure=True), 0.0
            return self._to_ground_beside(body, neighbor, bridge, area, rest, queries)
        x, y, _ = mean_position(assignment[i].position for i in self._centering_slots(number))
        z = max(vertical_extent(support)[1] for support in supports)
        z += queries.rise_m(body)
        yaw, period = None, piece.yaw_period_rad
        if len(supports) == 2:
            (ax, ay, _), (bx, by, _) = (support.position for support in supports)
            yaw = math.atan2(by - ay, bx - ax) - math.pi / 2
        else:
            support = self.pieces[supports[0]]
            yaw = support.yaw_rad(supports[0])
            if bridge is not None:
                x, y = self._point_on_support(body, supports[0], neighbor, bridge.span.aim_m)
            period = min(period, support.yaw_period_rad)
        if not slot.inherits_yaw:
            yaw = None
        deficit_m = 0.0
        if sum(other is not None for other in assignment) == 1:
            deficit_m = float(queries.site_deficit_m(np.array([[(x, y)]]), rest)[0])
        return Move(body, piece, (x, y, z), yaw, period, tuple(supports)), deficit_m

    def _centering_slots(self, number: int) -> tuple[int, ...]:
        """Return the slots over whose mean position a piece is placed; in a tower, the two below.

        Centred over the upper one only, a piece would tip over a tower that leans.
        """
        slots = self.blueprint.slots
        on = slots[number].centered_over or slots[number].on
        below = slots[on[0]].on if len(on) == 1 else ()
        return (*on, *below) if len(below) == 1 else on

    def _point_on_support(
        self, body: Body, support: Body, neighbor: Body | None, distance_m: float
    ) -> tuple[float, float]:
        """Return where on a long support one of the two pieces under a bridge is placed.

        Args:
            body: the piece.
            support: the long support.
            neighbor: the other piece, if it is on the support already.
            distance_m: distance between the two pieces.
        """
        yaw = self.pieces[support].yaw_rad(support) + math.pi / 2
        ux, uy = math.cos(yaw), math.sin(yaw)
        sx, sy, _ = support.position

        def along(other: Body) -> float:
            x, y, _ = other.position
            return (x - sx) * ux + (y - sy) * uy

        if neighbor is None:
            offset = math.copysign(distance_m / 2, along(body))
        else:
            offset = along(neighbor) - math.copysign(distance_m, along(neighbor))
        return sx + offset * ux, sy + offset * uy

    def _to_ground_beside(
        self,
        body: Body,
        neighbor: Body,
        bridge: Slot,
        area: PlacementArea,
        rest: Sequence[Body],
        queries: GraspQueries,
    ) -> tuple[Move, float]:
        """Return the move of a body to the ground beside another, and the clearance it lacks there.

        Args:
            body: the body to move.
            neighbor: the other body.
            bridge: the slot that both will support.
            area: where pieces may be placed on the ground.
            rest: the pieces that remain to be picked.
            queries: answers about the gripper.
        """
        piece = self.pieces[body]
        x, y, _ = body.position
        center = np.array(neighbor.position[:2])
        start = math.atan2(y - center[1], x - center[0])
        if area.line_yaw_rad is None:
            bearings = start + math.pi / BEARINGS * np.arange(2 * BEARINGS)
        else:
            bearings = area.line_yaw_rad + np.array([0.0, math.pi])
        directions = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
        radii = np.full(len(directions), bridge.span.aim_m)
        yaw = None
        if bridge.span.gap_m is not None:
            # the side that faces the neighbour is one on which the fingers do not close
            side = piece.grasp_yaws_rad[0] + math.pi / 2
            cos, sin = math.cos(side), math.sin(side)
            far = (body.shape.vertices[:, :2] @ [cos, sin]).max()
            near = (body.shape.vertices[:, :2] @ [-cos, -sin]).max()
            radii = extent_along_m(neighbor, directions) + max(far, near) + bridge.span.gap_m
            yaw = -side
        sites = center + radii[:, None] * directions
        others = [other for other in self.pieces if other is not body and other is not neighbor]
        deficits = placement_deficit_m(sites, body, others, area, in_structure=True)
        length = max(
            (
                np.ptp(other.shape.vertices[:, 1])
                for other, other_piece in self.pieces.items()
                if other_piece.kind == bridge.piece.kind
            ),
            default=0.0,
        )
        along = radii[:, None] / 2 + length / 2 * np.linspace(-1.0, 1.0, SITE_POINTS)
        footprints = center + along[:, :, None] * directions[:, None]
        deficits = deficits + queries.site_deficit_m(footprints, rest)
        distances = np.hypot(sites[:, 0] - x, sites[:, 1] - y)
        best = int(np.lexsort((radii + distances, deficits.round(6)))[0])
        site = tuple(sites[best].tolist())
        origin = area.origin_pose(site, queries.rise_m(body), footprint_radius_m(body))
        target_yaw = None if yaw is None else float(yaw + bearings[best])
        period = piece.yaw_period_rad
        move = Move(body, piece, origin.position, target_yaw, period, (), origin.orientation)
        return move, float(deficits[best])

    def _to_ground(
        self,
        body: Body,
        area: PlacementArea,
        queries: GraspQueries,
        *,
        in_structure: bool = False,
    ) -> Move:
        """Return the move of a body to the nearest free site on the ground.

        Args:
            body: the body to move.
            area: where pieces may be placed on the ground.
            queries: answers about the gripper.
            in_structure: whether the body is the base of the structure, instead of placed aside.
        """
        piece = self.pieces[body]
        others = [other for other in self.pieces if other is not body]
        site = nearest_free_site(body, others, area, in_structure=in_structure)
        origin = area.origin_pose(site, queries.rise_m(body), footprint_radius_m(body))
        heading = area.building.heading_rad if in_structure else None
        yaw = None if heading is None else heading + math.pi / 2 - piece.grasp_yaws_rad[0]
        return Move(body, piece, origin.position, yaw, piece.yaw_period_rad, (), origin.orientation)
