"""The progress of a structure, from its blueprint."""

from __future__ import annotations

import math

from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.manipulation.progress_terms import nearness, reach, staged
from ba_torchrl.tasks.structures.assignment import Assignment, mean_position
from ba_torchrl.tasks.structures.structure import Structure


def structure_progress(structure: Structure, robot: Robot, *, moves_gradually: bool) -> float:
    """Return the share of filled slots, plus the part of the way of one more piece to its slot.

    Of the slots whose supports are filled and the pieces of their kind that fill no slot, the pair
    that is farthest on its way counts. If the gripper moves gradually (close loop), its stages are
    equal: reach of the gripper to the piece, grasp, and nearness of the held piece to its place. If
    an action is a whole pick or place (open loop), a held piece is half of the way on, and another
    one less than that, in proportion to the nearness to its place.
    """
    held = robot.held_body()
    assigner, slots = structure.assigner(held), structure.blueprint.slots
    assignments, filled = assigner.largest_assignments()

    def distance_m(body: Body, number: int, assignment: Assignment) -> float:
        """Return the distance of a piece from its place in a slot whose supports are filled.

        It is infinite where only the ground and no other piece defines the place: a piece on the
        ground that does not fill such a slot stands where the terrain supports no structure.
        """
        slot, (x, y, _) = slots[number], body.position
        bridge, partner = structure.blueprint.bridge_on(number)
        other = None if partner is None else assignment[partner]
        if not slot.on and other is None:
            return math.inf
        below = [assignment[i] for i in slot.centered_over or slot.on]
        floor_m = max(
            (vertical_extent(assignment[i])[1] for i in slot.on),
            default=structure.terrain.height_m((x, y)),
        )
        center = mean_position(b.position for b in below) if below else body.position
        aside_m = math.dist((x, y), center[:2])
        if bridge is not None:  # beside another piece, under it
            aside_m = max(aside_m - bridge.span.most_m / 2, 0.0)
            if other is not None:
                aside_m += assigner.span_error_m(bridge, body, other)
        return math.hypot(aside_m, vertical_extent(body)[0] - floor_m)

    def part(body: Body, number: int, assignment: Assignment) -> float:
        near = nearness(distance_m(body, number, assignment))
        if not moves_gradually:
            return 0.5 if body is held else 0.5 * near
        if body is held:
            return (2 + near) / 3
        return reach(robot, body, structure.pieces[body].grasp_yaws(body)) / 3

    parts = (
        part(body, number, assignment)
        for assignment in assignments
        for number, slot in enumerate(slots)
        if assignment[number] is None and all(assignment[i] is not None for i in slot.on)
        for body, piece in structure.pieces.items()
        if piece.kind == slot.piece.kind and body not in assignment
    )
    return staged((filled + max(parts, default=0.0)) / len(slots))
