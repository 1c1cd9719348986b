"""Expert of structures in open loop: the pick or place of the planner's next move."""

from __future__ import annotations

import math
from collections.abc import Iterator
from operator import itemgetter

from ba_torchrl.core.actions import PickPlaceCommand, wrap_angle
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.control.pick_place import PickPlaceLimits
from ba_torchrl.sim.geometry import Pose, carrying_pose, quaternion_matrix, quaternion_yaw
from ba_torchrl.tasks.manipulation.pick_place_commands import (
    no_op,
    perturbed_pick,
    pick_command,
    place_command,
    swaps_fingers,
)
from ba_torchrl.tasks.manipulation.top_down_grasps import is_reachable
from ba_torchrl.tasks.structures.free_space import PlacementArea
from ba_torchrl.tasks.structures.moves import Move
from ba_torchrl.tasks.structures.piece_grasps import SUFFICIENT_CLEARANCE_M, PickPlaceGrasps, Tilted
from ba_torchrl.tasks.structures.planner import next_moves
from ba_torchrl.tasks.structures.tilts import release_pose, resting_frame

RELEASE_YAWS = 8
"""Yaws per half turn that are compared for a place with any yaw."""
EQUAL_CLEARANCE_M = 2e-3
"""Clearances of places whose difference is at most this are equally good."""
BORDER_BLOCKS = 1.5
"""Distance of placements from the border of their area, in blocks."""


class PickPlaceExpert:
    """Returns the pick or place of the planner's next move; made for one decision."""

    def __init__(self, grasps: PickPlaceGrasps) -> None:
        self.grasps = grasps
        self.structure = grasps.structure
        self.robot = grasps.robot
        self.terrain = grasps.terrain
        self.limits = grasps.limits

    def commands(self) -> Iterator[PickPlaceCommand]:
        """Yield the pick or place of the planner's next move, a no-op if the structure stands; then
        picks of pieces alike, or places in slots alike and at other yaws, that are as good."""
        held = self.robot.held_body()
        moves = next_moves(self.structure.assigner(held), self.placement_area(), self.grasps)
        if not moves:
            yield no_op(self.terrain.workspace, held is not None)
        elif moves[0].body is held:
            for move in moves:
                yield from self._places(move)
        else:
            yield self._first_pick(moves[0])
            if self.grasps.is_free(moves[0].body):
                free = (move.body for move in moves[1:] if self.grasps.is_free(move.body))
                yield from map(self.pick, free)

    def _first_pick(self, move: Move) -> PickPlaceCommand:
        """Return the pick of a move's piece, or of a piece that is in its way."""
        body = self._piece_to_pick(move.body)
        if self.limits.turn_rad and not self.grasps.is_free(body):
            grasp = self.grasps.attempt(body)
            if isinstance(grasp, Tilted):  # straight down, the arm reaches it with any deviation
                grasp = grasp.upright()
            tool = self.grasps.tool_pose(body, grasp)
            return perturbed_pick(self.structure.world, body, tool, self.limits)
        return self.pick(body)

    def _piece_to_pick(self, body: Body) -> Body:
        """Return the piece to pick so that a body can be picked.

        This is the body itself if it has a grasp with clearance, else a piece outside of the
        structure that blocks its grasps and has one. A gripper that cannot turn pushes them.
        """
        grasps = self.grasps
        if not self.limits.turn_rad or grasps.is_free(body):
            return body
        placed = self.structure.assigner(None).placed()
        blocking = (
            other
            for other in grasps.others(body)
            if other not in placed
            and all(grasps.blocks_grasp(body, other, None))
            and grasps.is_free(other)
        )
        return next(blocking, body)

    def pick(self, body: Body) -> PickPlaceCommand:
        """Return the pick of a body at its best grasp."""
        return pick_command(self.grasps.tool_pose(body, self.grasps.attempt(body)))

    def placement_area(self) -> PlacementArea:
        """Return where pieces may be placed on the ground."""
        border_m = BORDER_BLOCKS * self.structure.block_m
        return PlacementArea(
            self.terrain,
            self.terrain.build_area.shrunk(border_m),
            self.terrain.aside_area.shrunk(border_m),
            gap_m=2.0 * self.structure.block_m,
            # fingers at yaw 0 close along x, on pieces that lie along y
            line_yaw_rad=None if self.limits.turn_rad else math.pi / 2,
        )

    def _places(self, move: Move) -> Iterator[PickPlaceCommand]:
        """Yield the places that bring the held body to the pose of a move.

        Of several yaws they are the first at which the opening fingers have the largest clearance,
        then those at which they have as much.
        """
        tool, held = self.robot.tool_frame(), move.body.pose
        if self.limits.can_tilt:
            for pose in self._best_releases(move):
                yield place_command(tool, held, pose)
            return
        if not self.limits.turn_rad:
            yaws = [0.0]
        elif move.yaw_rad is None:
            yaws = [math.pi * i / RELEASE_YAWS for i in range(RELEASE_YAWS)]
        else:
            aligned = tool.yaw_rad + wrap_angle(move.yaw_rad - move.piece.yaw_rad(move.body))
            count = max(1, round(math.pi / move.yaw_period_rad))  # a half turn swaps the fingers
            yaws = [aligned + move.yaw_period_rad * i for i in range(count)]

        def clearance_m(yaw_rad: float) -> float:
            found_m = self.grasps.clearance_m(move.body, yaw_rad, move.position)
            return min(found_m, SUFFICIENT_CLEARANCE_M)

        if len(yaws) > 1:
            clearances_m = {yaw: clearance_m(yaw) for yaw in yaws}
            best = max(yaws, key=clearances_m.get)
            least_m = clearances_m[best] - EQUAL_CLEARANCE_M
            yaws = [best, *(y for y in yaws if y != best and clearances_m[y] >= least_m)]
        for yaw in yaws:
            yield place_command(tool, held, held.moved_to(move.position, yaw - tool.yaw_rad))

    def _release_poses(self, move: Move) -> list[Pose]:
        """Return the poses at which the held body can be released parallel to its support."""
        heading = quaternion_yaw(resting_frame(move.piece, move.body))
        if move.yaw_rad is None:
            first = heading - self.robot.tool_frame().yaw_rad  # the tool at yaws from zero
            yaws = [first + math.pi * i / RELEASE_YAWS for i in range(2 * RELEASE_YAWS)]
        else:
            count = max(1, round(2 * math.pi / move.yaw_period_rad))
            yaws = [move.yaw_rad + move.yaw_period_rad * i for i in range(count)]
            yaws.sort(key=lambda yaw: abs(wrap_angle(yaw - heading)))
        origin = Pose(move.position, move.surface)
        return [release_pose(move.piece, move.body, origin, yaw) for yaw in yaws]

    def _best_releases(self, move: Move) -> Iterator[Pose]:
        """Yield the pose of the held body at its release that is the best of those within reach,
        then those that are as good.

        Poses that the tool reaches without a half turn come first: the held body may be tilted or
        off the centre of the fingers.
        """
        tool, held = self.robot.tool_frame(), move.body.pose

        def quality(pose: Pose) -> tuple[bool, float]:
            is_exact = not swaps_fingers(carrying_pose(tool, held, pose))
            return is_exact, self._release_clearance_m(move, pose)

        ranked = [(quality(pose), pose) for pose in self._release_poses(move)]
        ranked.sort(key=itemgetter(0), reverse=True)
        supports, clearance_m = self.terrain.support_ids, PickPlaceLimits().pre_place_height_m
        least = None
        for (is_exact, found_m), pose in ranked:
            if least is not None and (is_exact, found_m) < least:
                return
            target = carrying_pose(tool, held, pose)
            if is_reachable(self.robot, supports, target, clearance_m):
                least = least or (is_exact, found_m - EQUAL_CLEARANCE_M)
                yield pose
        if least is None:
            yield ranked[0][1]

    def _release_clearance_m(self, move: Move, target: Pose) -> float:
        """Return the clearance of the opening fingers, less what they lack above the ground."""
        tool = carrying_pose(self.robot.tool_frame(), move.body.pose, target)
        gripper, (x, y, z) = self.robot.gripper, tool.position
        rotation = quaternion_matrix(tool.orientation)
        lowest = self.terrain.lowest_tool_m(gripper, (x, y), rotation, self.robot.opening())
        (clearance_m,) = self.grasps.clearances_m(
            move.body, [Tilted(tool.orientation)], self.grasps.others(move.body), tool.position
        )
        return min(clearance_m, SUFFICIENT_CLEARANCE_M) - max(lowest - z, 0.0)
