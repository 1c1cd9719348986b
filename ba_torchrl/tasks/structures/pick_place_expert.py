"""Open-loop expert for structures: grasps and release yaws for the moves of a planner."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ba_torchrl.actions import PickPlaceCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, footprint_radius_m
from ba_torchrl.sim.geometry import PlanarFrame, Vector, downward_pose
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.clearance import grasp_clearance_m, hand_clearance_m, path_clearance_m
from ba_torchrl.tasks.perturbation import perturbed_pick
from ba_torchrl.tasks.pick_place_commands import no_op, pick_command, place_command
from ba_torchrl.tasks.structures.blocking import GraspCandidate, GraspQueries, edge_grasps
from ba_torchrl.tasks.structures.free_space import PlacementArea
from ba_torchrl.tasks.structures.planner import DEFICIT_WEIGHT, Move
from ba_torchrl.tasks.structures.structure import Structure
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
        candidate = self._best_grasp(body)
        yaw, z = candidate.yaw_rad, body.position[2]
        x, y = _tool_xy(body.position, candidate)
        z = max(z, self.terrain.lowest_tool_m(self.robot.gripper, (x, y)))
        grasp = downward_pose((x, y, z), yaw)
        if self.limits.turn_rad and not self._is_free(body):
            return perturbed_pick(self.structure.planner.world, body, grasp, can_turn=True)
        return pick_command(grasp)

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
        return PlacementArea(
            *self.terrain.build_area.shrunk(1.5 * self.block_m),
            gap_m=2.0 * self.block_m,
            height_m=self.terrain.height_m,
            # fingers at yaw 0 close along x, on pieces that lie along y
            line_yaw_rad=None if self.limits.turn_rad else math.pi / 2,
        )

    def _grasp_candidates(self, body: Body) -> list[GraspCandidate]:
        """Return the grasps of a body, the centred ones first."""
        candidates = [GraspCandidate(yaw) for yaw in self.grasp_yaws(body)]
        # edge grasps only without yaw, and on the ground: on others a body drags its support along
        if not self.limits.turn_rad and self._is_on_ground(body):
            gripper, opening = self.robot.gripper, self.finger_opening
            for candidate in tuple(candidates):
                candidates += edge_grasps(gripper, body, candidate.yaw_rad, opening)
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
        return max(
            self._grasp_candidates(body),
            key=lambda candidate: self._grasp_quality(body, candidate),
        )

    def _is_on_ground(self, body: Body) -> bool:
        return self.terrain.gap_below_m(body) < self.block_m / 4

    def _grasp_quality(self, body: Body, candidate: GraspCandidate) -> tuple[float, bool, float]:
        """Return the quality of a grasp, by which grasps are compared.

        Returns:
            The clearance if it is negative, else 0; whether the grasp is centred; and the clearance
            including that of the near finger.
        """
        others = self._others(body)
        clearance_m = least_m = self._clearance_m(body, candidate, others, None)
        if candidate.shift_m:
            gripper, yaw = self.robot.gripper, candidate.yaw_rad
            near = (candidate.near_finger_range_m,)
            least_m = min(clearance_m, path_clearance_m(gripper, body, yaw, near, others))
        return min(clearance_m, 0.0), not candidate.shift_m, least_m

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
        (x, y), z = _tool_xy(at, candidate), at[2]
        extent = math.hypot(*self.robot.hand_half_extents_m) + SUFFICIENT_CLEARANCE_M
        others = [
            other
            for other in others
            if math.dist(other.position[:2], (x, y)) < extent + footprint_radius_m(other)
        ]
        gripper, yaw = self.robot.gripper, candidate.yaw_rad
        if candidate.shift_m:
            far = (candidate.far_finger_range_m,)
            fingers = path_clearance_m(gripper, body, yaw, far, others, at)
        else:
            fingers = grasp_clearance_m(gripper, body, yaw, others, self.finger_opening, at)
        return min(fingers, hand_clearance_m(self.robot, PlanarFrame(x, y, yaw), z, others))

    def _place(self, move: Move) -> PickPlaceCommand:
        """Return the place that brings the held body to the pose of a move."""
        tool, held = self.robot.tool_frame(), move.body.pose
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

    def _release_yaw(self, move: Move, yaws_rad: Sequence[float]) -> float:
        """Return the first of the yaws at which the opening fingers have the largest clearance."""
        clearances = [
            min(self.clearance_m(move.body, yaw, move.position), SUFFICIENT_CLEARANCE_M)
            for yaw in yaws_rad
        ]
        return yaws_rad[clearances.index(max(clearances))]


def _tool_xy(position: Vector, candidate: GraspCandidate) -> tuple[float, float]:
    """Return x and y of the tool for a grasp of a body at a position."""
    return PlanarFrame(*position[:2], candidate.yaw_rad).to_world(candidate.shift_m, 0.0)
