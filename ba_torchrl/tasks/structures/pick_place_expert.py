"""Open-loop expert for structures: grasps and release yaws for the moves of a planner."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ba_torchrl.actions import PickPlaceCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, footprint_radius_m
from ba_torchrl.sim.geometry import (
    PlanarFrame,
    Pose,
    Vector,
    downward_pose,
    quaternion_matrix,
    quaternion_yaw,
)
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.clearance import (
    grasp_clearance_m,
    hand_clearance_m,
    path_clearance_m,
    tool_view,
)
from ba_torchrl.tasks.perturbation import perturbed_pick
from ba_torchrl.tasks.pick_place_commands import (
    LEVEL_RAD,
    carrying_pose,
    no_op,
    pick_command,
    place_command,
)
from ba_torchrl.tasks.structures.blocking import GraspCandidate, GraspQueries, edge_grasps
from ba_torchrl.tasks.structures.free_space import PlacementArea
from ba_torchrl.tasks.structures.planner import DEFICIT_WEIGHT, Move
from ba_torchrl.tasks.structures.structure import Structure
from ba_torchrl.tasks.structures.tilted_grasps import (
    in_resting_frame,
    is_reachable,
    release_pose,
    tilted_tools,
)
from ba_torchrl.tasks.terrain import Terrain
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
RAISE_BLOCKS = 0.3
"""Largest height, in blocks, by which a grasp is raised so that the fingers clear the ground."""
LENGTH_SHARES = (-0.1, 0.1, -0.2, 0.2, -0.3, 0.3)
"""Positions of grasps off the centre of a long piece, as a multiple of its length."""
SUFFICIENT_CLEARANCE_M = 0.02
"""Clearances above this are equally good."""


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
        self.finger_opening = finger_opening
        self.clears_blocked_pieces = clears_blocked_pieces

    @property
    def block_m(self) -> float:
        """Edge of a block."""
        return self.structure.block_m

    def command(self) -> PickPlaceCommand:
        """Return the pick or place of the planner's next move; a no-op if the structure stands."""
        held = self.robot.held_body()
        move = self.structure.planner.next_move(self._placement_area(), held, self)
        if move is None:
            return no_op(self.terrain.workspace, held is not None)
        if move.body is held:
            return self._place(move)
        body = self._unblocking(move.body)
        if self.limits.turn_rad and not self._is_free(body):
            grasp = self._tool_pose(body, self._best_grasp(body))
            return perturbed_pick(self.structure.planner.world, body, grasp, can_turn=True)
        return self.pick(body)

    def pick(self, body: Body) -> PickPlaceCommand:
        """Return the pick of a body at its best grasp."""
        return pick_command(self._tool_pose(body, self._best_grasp(body)))

    def rise_m(self, body: Body) -> float:
        """Return the height of a piece's origin above its support when it is released.

        A gripper that can tilt releases it parallel to the support.
        """
        if not self.limits.can_tilt:
            return super().rise_m(body)
        rows = quaternion_matrix(in_resting_frame(self.structure.planner.pieces[body], body))
        return -float((body.shape.vertices @ rows[2]).min())

    def grasp_yaws(self, body: Body) -> list[float]:
        """Return the yaws of the gripper at which it can grasp a body."""
        if not self.limits.turn_rad:
            return [0.0]
        return self.structure.planner.pieces[body].grasp_yaws(body)

    def clearance_m(self, body: Body, yaw_rad: float, position: Vector | None = None) -> float:
        """Return the clearance between the hand, opened around a body, and the other pieces.

        Args:
            body: the body.
            yaw_rad: yaw of the gripper.
            position: assumed position of the body; its present one if None.

        Returns:
            Metres; exact up to `SUFFICIENT_CLEARANCE_M`, infinite if no piece is near.
        """
        return self._clearance_m(body, GraspCandidate(yaw_rad), self._others(body), position)

    # -- queries of the planner --------------------------------------------------------------

    def pick_cost_m(self, body: Body) -> float:
        """Return the cost of a pick: 0 with clearance, else more the more clearance is missing.

        A grasp that pushes a neighbour costs the distance by which that leaves the workspace.
        """
        candidate = self._best_grasp(body)
        deficit_m, _, clearance_m = self._grasp_quality(body, candidate)
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
            grasps = self.grasp_yaws(other)
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
        return [
            self._clearance_m(body, candidate, [other], at) <= 0
            for candidate in self._grasp_candidates(body)
        ]

    # ----------------------------------------------------------------------------------------

    def _others(self, body: Body) -> list[Body]:
        return [other for other in self.structure.pieces if other is not body]

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

    def _grasp_candidates(self, body: Body) -> list[GraspCandidate]:
        """Return the grasps of a body, the centred ones first.

        A body on a slope is grasped along the normal of its side, as far as the arm can reach.
        """
        piece = self.structure.planner.pieces[body]
        candidates = [GraspCandidate(yaw) for yaw in self.grasp_yaws(body)]
        if self.limits.can_tilt and piece.tilt_rad(body) >= LEVEL_RAD:
            tools = tilted_tools(piece, body)
            candidates = [GraspCandidate(quaternion_yaw(tool), tool=tool) for tool in tools]
        centered = tuple(candidates)
        if self.limits.can_tilt and len(piece.grasp_yaws_rad) == 1:
            yaw = piece.grasp_yaws_rad[0]
            length_m = np.ptp(body.shape.vertices[:, :2] @ (-math.sin(yaw), math.cos(yaw)))
            candidates += [
                candidate._replace(along_m=float(share * length_m))
                for share in LENGTH_SHARES
                for candidate in centered
            ]
        # edge grasps not if the gripper turns straight down only: it finds a free yaw; and only on
        # the ground: on others a body drags its support along
        if (self.limits.can_tilt or not self.limits.turn_rad) and self._is_on_ground(body):
            gripper, opening = self.robot.gripper, self.finger_opening
            for candidate in centered:
                for side, edge in zip(
                    (1, -1), edge_grasps(gripper, body, candidate.yaw_rad, opening), strict=False
                ):
                    if candidate.tool is None:
                        candidates.append(edge)
                    else:
                        candidates.append(candidate._replace(shift_m=side * edge.shift_m))
        return candidates

    def _unblocking(self, body: Body) -> Body:
        """Return the piece to pick so that a body can be picked.

        This is the body itself if it has a grasp with clearance, else a piece outside of the
        structure that blocks its grasps and has one. A gripper that cannot turn pushes them.
        """
        if not self.limits.turn_rad or self._is_free(body):
            return body
        placed = self.structure.planner.placed()
        return next(
            (
                other
                for other in self._others(body)
                if other not in placed
                and all(self.blocks_grasp(body, other, None))
                and self._is_free(other)
            ),
            body,
        )

    def _is_free(self, body: Body) -> bool:
        """Whether a grasp of a body has clearance."""
        return self._grasp_quality(body, self._best_grasp(body))[2] > 0

    def _best_grasp(self, body: Body) -> GraspCandidate:
        """Return the best grasp of a body; with tilts, the best of those that the arm reaches."""
        ranked = sorted(
            self._grasp_candidates(body),
            key=lambda candidate: self._grasp_quality(body, candidate),
            reverse=True,
        )
        if not self.limits.can_tilt:
            return ranked[0]
        reachable = (c for c in ranked if is_reachable(self.robot, self._tool_pose(body, c)))
        return next(reachable, ranked[0])

    def _is_on_ground(self, body: Body) -> bool:
        return self.terrain.gap_below_m(body) < self.block_m / 4

    def _grasp_quality(self, body: Body, candidate: GraspCandidate) -> tuple[float, float, float]:
        """Return the quality of a grasp, by which grasps are compared.

        Returns:
            The clearance if it is negative, else 0; how close the grasp is to the centre, at most
            0; and the clearance including that of the near finger.
        """
        if self.limits.can_tilt and self._raise_m(body, candidate) > RAISE_BLOCKS * self.block_m:
            return -1.0, 0.0, -1.0
        others = self._others(body)
        clearance_m = least_m = self._clearance_m(body, candidate, others, None)
        if candidate.shift_m:
            gripper, yaw = self.robot.gripper, candidate.yaw_rad
            near = (candidate.near_finger_range_m,)
            least_m = min(clearance_m, path_clearance_m(gripper, body, yaw, near, others))
        if candidate.tool is not None:  # the largest tilt with enough clearance comes first
            least_m = min(least_m, SUFFICIENT_CLEARANCE_M)
        centering = -abs(candidate.along_m) - bool(candidate.shift_m)
        return min(clearance_m, 0.0), centering, least_m

    def _tool_pose(self, body: Body, candidate: GraspCandidate) -> Pose:
        """Return the pose of the tool for a grasp, raised so that the fingers clear the ground."""
        x, y, z = _tool_position(body.position, candidate)
        rotation = None if candidate.tool is None else quaternion_matrix(candidate.tool)
        lowest = self.terrain.lowest_tool_m(self.robot.gripper, (x, y), rotation)
        if candidate.tool is None:
            return downward_pose((x, y, max(z, lowest)), candidate.yaw_rad)
        return Pose((x, y, max(z, lowest)), candidate.tool)

    def _raise_m(self, body: Body, candidate: GraspCandidate) -> float:
        """Return the height by which a grasp is raised so that the fingers clear the ground."""
        at = _tool_position(body.position, candidate)
        return self._tool_pose(body, candidate).position[2] - at[2]

    def _clearance_m(
        self,
        body: Body,
        candidate: GraspCandidate,
        others: Sequence[Body],
        position: Vector | None,
    ) -> float:
        """Return the clearance between the hand, opened around a body, and some other bodies.

        Of an edge grasp only the far finger counts.
        """
        at = body.position if position is None else position
        x, y, z = grasp = _tool_position(at, candidate)
        extent = math.hypot(*self.robot.hand_half_extents_m) + SUFFICIENT_CLEARANCE_M
        others = [
            other
            for other in others
            if math.dist(other.position[:2], (x, y)) < extent + footprint_radius_m(other)
        ]
        gripper, yaw = self.robot.gripper, candidate.yaw_rad
        if candidate.tool is not None:
            view, tool = tool_view(Pose(grasp, candidate.tool)), PlanarFrame(x, y, 0.0)
            fingers = grasp_clearance_m(
                gripper, body, 0.0, others, self.finger_opening, grasp, view
            )
            return min(fingers, hand_clearance_m(self.robot, tool, z, others, view))
        if candidate.shift_m:
            far = (candidate.far_finger_range_m,)
            fingers = path_clearance_m(gripper, body, yaw, far, others, at)
        else:
            fingers = grasp_clearance_m(gripper, body, yaw, others, self.finger_opening, grasp)
        return min(fingers, hand_clearance_m(self.robot, PlanarFrame(x, y, yaw), z, others))

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
        """Return the pose of the held body at its release, the best of those within reach."""
        tool, held = self.robot.tool_frame(), move.body.pose
        ranked = sorted(
            self._release_poses(move),
            key=lambda pose: self._release_clearance_m(move, pose),
            reverse=True,
        )
        reachable = (
            pose for pose in ranked if is_reachable(self.robot, carrying_pose(tool, held, pose))
        )
        return next(reachable, ranked[0])

    def _release_clearance_m(self, move: Move, target: Pose) -> float:
        """Return the clearance of the opening fingers, less what they lack above the ground."""
        tool = carrying_pose(self.robot.tool_frame(), move.body.pose, target)
        gripper, (x, y, z) = self.robot.gripper, tool.position
        rotation = quaternion_matrix(tool.orientation)
        lowest = self.terrain.lowest_tool_m(gripper, (x, y), rotation, self.robot.opening())
        candidate = GraspCandidate(tool.yaw_rad, tool=tool.orientation)
        clearance_m = self._clearance_m(
            move.body, candidate, self._others(move.body), tool.position
        )
        return min(clearance_m, SUFFICIENT_CLEARANCE_M) - max(lowest - z, 0.0)

    def _release_yaw(self, move: Move, yaws_rad: Sequence[float]) -> float:
        """Return the first of the yaws at which the opening fingers have the largest clearance."""
        clearances = [
            min(self.clearance_m(move.body, yaw, move.position), SUFFICIENT_CLEARANCE_M)
            for yaw in yaws_rad
        ]
        return yaws_rad[clearances.index(max(clearances))]


def _tool_position(position: Vector, candidate: GraspCandidate) -> Vector:
    """Return the position of the tool for a grasp of a body at a position."""
    x, y, z = position
    if candidate.tool is None:
        frame = PlanarFrame(x, y, candidate.yaw_rad)
        return *frame.to_world(candidate.shift_m, candidate.along_m), z
    offset = (candidate.shift_m, -candidate.along_m, 0.0)  # the y axis of a tool is reversed
    return Pose(position, candidate.tool).compose(Pose(offset)).position
