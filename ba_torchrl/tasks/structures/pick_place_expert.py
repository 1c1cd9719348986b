"""Open-loop expert for structures: grasps and release yaws for the moves of a planner."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ba_torchrl.actions import PickPlaceCommand, wrap_angle
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.control.pick_place import PickPlaceLimits
from ba_torchrl.sim.geometry import (
    PlanarFrame,
    Pose,
    Vector,
    quaternion_matrix,
    quaternion_yaw,
)
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.manipulation.commands import (
    carrying_pose,
    no_op,
    perturbed_pick,
    pick_command,
    place_command,
    swaps_fingers,
)
from ba_torchrl.tasks.structures.blocking import GraspCandidate, GraspQueries
from ba_torchrl.tasks.structures.free_space import PlacementArea
from ba_torchrl.tasks.structures.grasp_selection import SUFFICIENT_CLEARANCE_M, GraspSelector
from ba_torchrl.tasks.structures.planner import DEFICIT_WEIGHT, Move
from ba_torchrl.tasks.structures.structure import Structure
from ba_torchrl.tasks.structures.tilted_grasps import (
    in_resting_frame,
    is_reachable,
    release_pose,
)
from ba_torchrl.tasks.terrain.flat import Terrain
from ba_torchrl.tasks.workspace import ActionLimits

SITE_GAP_M = 0.01
"""Gap wanted between a structure and the hand that picks a piece beside it."""
RELEASE_YAWS = 8
"""Yaws per half turn that are compared for a place with any yaw."""
BLOCKED_COST_M = 0.05
"""Cost of a pick without clearance."""
PUSHED_M = 0.16
"""Largest distance by which a finger that descends between two blocks pushes one of them."""
BORDER_BLOCKS = 1.5
"""Distance of placements from the border of their area, in blocks."""


class PickPlaceExpert(GraspQueries):
    """Returns the pick or place of the planner's next move, from any state of the scene.

    Args:
        structure: the pieces and their planner.
        robot: the robot.
        terrain: the ground.
        limits: limits of an action; a gripper that cannot turn grasps at yaw 0.
        finger_opening: opening of the fingers before a pick, 0 to 1.
        clears_blocked_pieces: whether to remove pieces that block the grasp of another piece.
    """

    def __init__(
        self,
        structure: Structure,
        robot: Robot,
        terrain: Terrain,
        limits: ActionLimits,
        *,
        finger_opening: float,
        clears_blocked_pieces: bool,
    ) -> None:
        self.structure = structure
        self.robot = robot
        self.terrain = terrain
        self.limits = limits
        self.grasps = GraspSelector(structure, robot, terrain, limits, finger_opening)
        self.clears_blocked_pieces = clears_blocked_pieces

    @property
    def block_m(self) -> float:
        """Edge of a block."""
        return self.structure.block_m

    def command(self) -> PickPlaceCommand:
        """Return the pick or place of the planner's next move; a no-op if the structure stands."""
        self.grasps.on_new_decision()
        held = self.robot.held_body()
        move = self.structure.planner.next_move(self._placement_area(), held, self)
        if move is None:
            return no_op(self.terrain.workspace, held is not None)
        if move.body is held:
            return self._place(move)
        body = self._unblocking(move.body)
        if self.limits.turn_rad and not self.grasps.is_free(body):
            # straight down, so that the arm reaches it with any deviation
            upright = self.grasps.best(body)._replace(tool=None)
            grasp = self.grasps.tool_pose(body, upright)
            return perturbed_pick(self.structure.planner.world, body, grasp, can_turn=True)
        return self.pick(body)

    def pick(self, body: Body) -> PickPlaceCommand:
        """Return the pick of a body at its best grasp."""
        return pick_command(self.grasps.tool_pose(body, self.grasps.best(body)))

    def rise_m(self, body: Body) -> float:
        """Return the height of a piece's origin above its support when it is released.

        A gripper that can tilt releases it parallel to the support.
        """
        if not self.limits.can_tilt:
            return super().rise_m(body)
        rows = quaternion_matrix(in_resting_frame(self.structure.planner.pieces[body], body))
        return -float((body.shape.vertices @ rows[2]).min())

    # -- queries of the planner --------------------------------------------------------------

    def pick_cost_m(self, body: Body) -> float:
        """Return the cost of a pick: 0 with clearance, else more the more clearance is missing.

        A grasp that pushes a neighbour costs the distance by which that leaves the workspace.
        """
        candidate = self.grasps.best(body)
        deficit_m, _, clearance_m = self.grasps.quality(body, candidate)
        if clearance_m > 0:
            return 0.0
        cost_m = BLOCKED_COST_M - DEFICIT_WEIGHT * deficit_m
        if candidate.shift_m and deficit_m == 0:
            x, y, _ = body.position
            end = PlanarFrame(x, y, candidate.yaw_rad).to_world(PUSHED_M, 0.0)
            ranges = self.terrain.workspace.x, self.terrain.workspace.y
            cost_m += max(
                max(low - e, e - high, 0.0) for e, (low, high) in zip(end, ranges, strict=True)
            )
        return cost_m

    def site_deficit_m(self, sites: np.ndarray, rest: Sequence[Body]) -> np.ndarray:
        """Return the clearance [S] that hand and load lack when they pick the remaining pieces.

        Args:
            sites: [S, P, 2] points of the ground that a structure at each site occupies, metres.
            rest: the pieces that remain to be picked.
        """
        if not rest:
            return np.zeros(len(sites))
        # rectangles around each piece: the hand at its first and last yaw, and the piece itself
        centers = np.array([other.position[:2] for other in rest])
        yaws, halves = [], []
        for other in rest:
            grasps = self.grasps.yaws(other)
            low, high = other.shape.bounds_m
            load = tuple(max(-a, b) for a, b in zip(low[:2], high[:2], strict=True))
            own_yaw = self.structure.planner.pieces[other].yaw_rad(other)
            yaws.append([grasps[0], grasps[-1], own_yaw])
            halves.append([self.robot.hand_half_extents_m, self.robot.hand_half_extents_m, load])
        x, y = np.moveaxis(sites[:, :, None] - centers, 3, 0)[..., None]  # [S, P, rest, 1]
        cos, sin = np.cos(yaws), np.sin(yaws)
        half_along, half_across = np.moveaxis(np.array(halves), 2, 0)
        along, across = np.abs(x * cos + y * sin), np.abs(y * cos - x * sin)
        gaps = np.maximum(along - half_along, across - half_across).min(axis=1)  # [S, rest, 3]
        gaps = np.minimum(gaps[:, :, :2].max(axis=2), gaps[:, :, 2])
        return np.maximum(SITE_GAP_M + self.block_m / 2 - gaps, 0.0).sum(axis=1)

    def blocks_grasp(self, body: Body, other: Body, position: Vector | None) -> list[bool]:
        """Return for each grasp candidate of a body whether another piece blocks it.

        Args:
            body: the body to grasp.
            other: the other piece.
            position: assumed position of the other piece; its present one if None.
        """
        at = body.position
        if position is not None:  # the body is displaced instead of the other piece
            coordinates = zip(at, other.position, position, strict=True)
            at = tuple(a + b - c for a, b, c in coordinates)
        candidates = self.grasps.candidates(body)
        return [gap_m <= 0 for gap_m in self.grasps.clearances_m(body, candidates, [other], at)]

    # ----------------------------------------------------------------------------------------

    def _placement_area(self) -> PlacementArea:
        border_m = BORDER_BLOCKS * self.block_m
        return PlacementArea(
            self.terrain,
            self.terrain.build_area.shrunk(border_m),
            self.terrain.aside_area.shrunk(border_m),
            gap_m=2.0 * self.block_m,
            # fingers at yaw 0 close along x, on pieces that lie along y
            line_yaw_rad=None if self.limits.turn_rad else math.pi / 2,
        )

    def _unblocking(self, body: Body) -> Body:
        """Return the piece to pick so that a body can be picked.

        This is the body itself if it has a grasp with clearance, else a piece outside of the
        structure that blocks its grasps and has one. A gripper that cannot turn pushes them.
        """
        if not self.limits.turn_rad or self.grasps.is_free(body):
            return body
        placed = self.structure.planner.placed()
        return next(
            (
                other
                for other in self.grasps.others(body)
                if other not in placed
                and all(self.blocks_grasp(body, other, None))
                and self.grasps.is_free(other)
            ),
            body,
        )

    def _place(self, move: Move) -> PickPlaceCommand:
        """Return the place that brings the held body to the pose of a move."""
        tool, held = self.robot.tool_frame(), move.body.pose
        if self.limits.can_tilt:
            return place_command(tool, held, self._best_release(move))
        yaw = tool.yaw_rad
        if not self.limits.turn_rad:
            yaw = 0.0
        elif move.yaw_rad is None:
            yaws = [math.pi * i / RELEASE_YAWS for i in range(RELEASE_YAWS)]
            yaw = self._release_yaw(move, yaws)
        else:
            aligned = tool.yaw_rad + wrap_angle(move.yaw_rad - move.piece.yaw_rad(move.body))
            count = max(1, round(math.pi / move.yaw_period_rad))  # a half turn swaps the fingers
            yaws = [aligned + move.yaw_period_rad * i for i in range(count)]
            yaw = self._release_yaw(move, yaws)
        return place_command(tool, held, held.moved_to(move.position, yaw - tool.yaw_rad))

    def _release_poses(self, move: Move) -> list[Pose]:
        """Return the poses at which the held body can be released parallel to its support."""
        heading = quaternion_yaw(move.piece.resting_frame(move.body))
        if move.yaw_rad is None:
            first = heading - self.robot.tool_frame().yaw_rad  # the tool at yaws from zero
            yaws = [first + math.pi * i / RELEASE_YAWS for i in range(2 * RELEASE_YAWS)]
        else:
            count = max(1, round(2 * math.pi / move.yaw_period_rad))
            yaws = [move.yaw_rad + move.yaw_period_rad * i for i in range(count)]
            yaws.sort(key=lambda yaw: abs(wrap_angle(yaw - heading)))
        origin = Pose(move.position, move.surface)
        return [release_pose(move.piece, move.body, origin, yaw) for yaw in yaws]

    def _best_release(self, move: Move) -> Pose:
        """Return the pose of the held body at its release, the best of those within reach.

        Poses that the tool reaches without a half turn come first: the held body may be tilted or
        off the centre of the fingers.
        """
        tool, held = self.robot.tool_frame(), move.body.pose

        def quality(pose: Pose) -> tuple[bool, float]:
            is_exact = not swaps_fingers(carrying_pose(tool, held, pose))
            return is_exact, self._release_clearance_m(move, pose)

        ranked = sorted(self._release_poses(move), key=quality, reverse=True)
        supports, clearance_m = self.terrain.support_ids, PickPlaceLimits().pre_place_height_m
        reachable = (
            pose
            for pose in ranked
            if is_reachable(self.robot, supports, carrying_pose(tool, held, pose), clearance_m)
        )
        return next(reachable, ranked[0])

    def _release_clearance_m(self, move: Move, target: Pose) -> float:
        """Return the clearance of the opening fingers, less what they lack above the ground."""
        tool = carrying_pose(self.robot.tool_frame(), move.body.pose, target)
        gripper, (x, y, z) = self.robot.gripper, tool.position
        rotation = quaternion_matrix(tool.orientation)
        lowest = self.terrain.lowest_tool_m(gripper, (x, y), rotation, self.robot.opening())
        candidate = GraspCandidate(tool.yaw_rad, tool=tool.orientation)
        (clearance_m,) = self.grasps.clearances_m(
            move.body, [candidate], self.grasps.others(move.body), tool.position
        )
        return min(clearance_m, SUFFICIENT_CLEARANCE_M) - max(lowest - z, 0.0)

    def _release_yaw(self, move: Move, yaws_rad: Sequence[float]) -> float:
        """Return the first of the yaws at which the opening fingers have the largest clearance."""
        clearances = [
            min(self.grasps.clearance_m(move.body, yaw, move.position), SUFFICIENT_CLEARANCE_M)
            for yaw in yaws_rad
        ]
        return yaws_rad[clearances.index(max(clearances))]
