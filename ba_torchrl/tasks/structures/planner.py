"""Planner of structures: which piece to move next, and where."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cache

import numpy as np

from ba_torchrl.sim.bodies import Body, footprint_radius_m, vertical_extent
from ba_torchrl.tasks.structures.assignment import Assignment, SlotAssigner, mean_position
from ba_torchrl.tasks.structures.blueprint import Slot
from ba_torchrl.tasks.structures.free_space import (
    PlacementArea,
    beside_supports,
    extent_along_m,
    nearest_free_site,
    placement_deficit_m,
)
from ba_torchrl.tasks.structures.grasps import DEFICIT_WEIGHT, GraspBlocking, Grasps, Move

BEARINGS = 16
"""Directions per half turn in which sites beside a piece are compared."""
SITE_POINTS = 7
"""Points along a bridge that represent the footprint of a structure."""
BLOCKED_MOVES = 100
"""Cost, in moves, of picking a piece whose grasps are all blocked."""


def next_move(assigner: SlotAssigner, area: PlacementArea, grasps: Grasps) -> Move | None:
    """Return the next move towards the structure; None if it stands.

    Pieces in their slots stay. Pieces that rest on a slot or on a piece that is needed next, and
    pieces that block its grasp, are placed on the ground first, from the top down. A held piece is
    placed before another is picked. Of the assignments, that with the fewest moves is followed.

    Args:
        area: where pieces may be placed on the ground.
    """
    return _Planner(assigner, area, grasps).next_move()


class _Planner:
    """The moves of one decision; arguments as for `next_move`."""

    def __init__(self, assigner: SlotAssigner, area: PlacementArea, grasps: Grasps) -> None:
        self.assigner = assigner
        self.area = area
        self.grasps = grasps
        self.pieces = assigner.pieces
        self.slots = assigner.blueprint.slots

    def next_move(self) -> Move | None:
        """Return the next move; None if the structure stands."""
        assigner, grasps, held = self.assigner, self.grasps, self.assigner.held
        pick_cost_m = cache(grasps.pick_cost_m)
        assignments, most = assigner.largest_assignments()
        holds_piece = held in self.pieces
        if most == len(self.slots):
            if holds_piece:
                return self._to_ground(held)
            misplaced = min(map(assigner.misplaced, assignments), key=len)
            return self._to_ground(min(misplaced, key=pick_cost_m)) if misplaced else None
        bodies_above = assigner.bodies_above()
        blocking = GraspBlocking(self.pieces, bodies_above, held, grasps)
        best: tuple[tuple[int, float], Move | Body] | None = None
        for assignment in assignments:
            choices = [*self._choices(assignment, bodies_above), *blocking.removals(assignment)]
            # cheap lower bounds first, so that most of the others are skipped
            for extra_moves, body, number in sorted(
                choices, key=lambda choice: choice[0] + (holds_piece and choice[1] is not held)
            ):
                # another held piece is placed on the ground before this choice
                places_held = holds_piece and body is not held
                extra_moves += places_held
                if body is not held and all(blocking.obstacles(body)):
                    extra_moves += BLOCKED_MOVES
                if best is not None and extra_moves > best[0][0]:
                    continue
                move, distance_m = body, 0.0
                if number is not None and not (places_held and not grasps.clears_blocked_pieces):
                    move, deficit_m = self._to_slot(body, number, assignment)
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
        return move if isinstance(move, Move) else self._to_ground(move)

    def _choices(
        self, assignment: Assignment, bodies_above: dict[Body, frozenset[Body]]
    ) -> Iterator[tuple[int, Body, int | None]]:
        """Yield the moves that fill an empty slot, or remove a piece so that one can be filled.

        Yields:
            Number of pieces to place on the ground first, the body to move, and the number of its
            slot; None for the ground.
        """
        assigner, blueprint = self.assigner, self.assigner.blueprint
        for number, slot in enumerate(self.slots):
            partner = blueprint.partner(number)
            if assignment[number] is not None or any(assignment[i] is None for i in slot.on):
                continue
            if partner is not None and partner < number and assignment[partner] is None:
                continue
            filled_partner = () if partner is None or assignment[partner] is None else (partner,)
            misplaced = assigner.misplaced(assignment, (*slot.on, *filled_partner))
            supports = [assignment[i] for i in slot.on]
            loose = [b for b in self.pieces if b not in assignment and b is not assigner.held]
            for body, piece in self.pieces.items():
                if piece.kind != slot.piece.kind or body in assignment:
                    continue
                others = [other for other in misplaced if other is not body]
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

    def _to_slot(self, body: Body, number: int, assignment: Assignment) -> tuple[Move, float]:
        """Return the move of a body to a slot, and the clearance in metres that it lacks there."""
        blueprint, slot, piece = self.assigner.blueprint, self.slots[number], self.pieces[body]
        supports = [assignment[i] for i in slot.on]
        partner = blueprint.partner(number)
        neighbor = None if partner is None else assignment[partner]
        bridge = None if partner is None else self.slots[blueprint.bridge_on(number)]
        rest = [other for other in self.pieces if other is not body and other not in assignment]
        if not supports:
            if neighbor is None:
                return self._to_ground(body, in_structure=True), 0.0
            return self._to_ground_beside(body, neighbor, bridge, rest)
        x, y, _ = mean_position(assignment[i].position for i in self._centering_slots(number))
        z = max(vertical_extent(support)[1] for support in supports)
        z += self.grasps.rise_m(body)
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
            deficit_m = float(self.grasps.site_deficit_m(np.array([[(x, y)]]), rest)[0])
        return Move(body, piece, (x, y, z), yaw, period, tuple(supports)), deficit_m

    def _centering_slots(self, number: int) -> tuple[int, ...]:
        """Return the slots over whose mean position a piece is placed; in a tower, the two below.

        Centred over the upper one only, a piece would tip over a tower that leans.
        """
        on = self.slots[number].centered_over or self.slots[number].on
        below = self.slots[on[0]].on if len(on) == 1 else ()
        return (*on, *below) if len(below) == 1 else on

    def _point_on_support(
        self, body: Body, support: Body, neighbor: Body | None, distance_m: float
    ) -> tuple[float, float]:
        """Return where on a long support one of the two pieces under a bridge is placed.

        Args:
            neighbor: the other piece, if it is on the support already.
            distance_m: distance between the two pieces.
        """
        yaw = self.pieces[support].yaw_rad(support) + math.pi / 2
        ux, uy = math.cos(yaw), math.sin(yaw)
        sx, sy, _ = support.position
        x, y, _ = (body if neighbor is None else neighbor).position
        along = (x - sx) * ux + (y - sy) * uy
        if neighbor is None:
            offset = math.copysign(distance_m / 2, along)
        else:
            offset = along - math.copysign(distance_m, along)
        return sx + offset * ux, sy + offset * uy

    def _to_ground_beside(
        self, body: Body, neighbor: Body, bridge: Slot, rest: Sequence[Body]
    ) -> tuple[Move, float]:
        """Return the move of a body to the ground beside another, and the clearance it lacks there.

        Args:
            bridge: the slot that both will support.
            rest: the pieces that remain to be picked.
        """
        piece, area = self.pieces[body], self.area
        x, y, _ = body.position
        center = np.array(neighbor.position[:2])
        if area.line_yaw_rad is None:
            start = math.atan2(y - center[1], x - center[0])
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
        deficits = deficits + self.grasps.site_deficit_m(footprints, rest)
        distances = np.hypot(sites[:, 0] - x, sites[:, 1] - y)
        best = int(np.lexsort((radii + distances, deficits.round(6)))[0])
        target_yaw = None if yaw is None else float(yaw + bearings[best])
        move = self._on_ground(body, tuple(sites[best].tolist()), target_yaw)
        return move, float(deficits[best])

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
        return Move(body, piece, origin.position, yaw_rad, period, (), origin.orientation)
