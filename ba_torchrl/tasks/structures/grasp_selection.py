"""Grasps of the pieces of a structure: candidates, their clearance and their reach."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body, footprint_radius_m, world_vertices
from ba_torchrl.sim.geometry import (
    PlanarFrame,
    Pose,
    Vector,
    downward_pose,
    quaternion_matrix,
    quaternion_yaw,
)
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.manipulation.clearance import (
    grasp_clearance_m,
    hand_clearance_m,
    path_clearance_m,
    tool_clearances_m,
)
from ba_torchrl.tasks.manipulation.commands import LEVEL_RAD
from ba_torchrl.tasks.structures.blocking import GraspCandidate, edge_grasps
from ba_torchrl.tasks.structures.structure import Structure
from ba_torchrl.tasks.structures.tilted_grasps import is_reachable, tilted_tools
from ba_torchrl.tasks.terrain.flat import Terrain
from ba_torchrl.tasks.workspace import ActionLimits

RAISE_BLOCKS = 0.3
"""Largest height, in blocks, by which a grasp is raised so that the fingers clear the ground."""
LENGTH_SHARES = (-0.1, 0.1, -0.2, 0.2, -0.3, 0.3)
"""Positions of grasps off the centre of a long piece, as a multiple of its length."""
SUFFICIENT_CLEARANCE_M = 0.02
"""Clearances above this are equally good."""


class Quality(NamedTuple):
    """Quality of a grasp; a larger one is better."""

    deficit_m: float
    """The clearance if it is negative, else 0."""
    centering_m: float
    """How close the grasp is to the centre, at most 0."""
    clearance_m: float
    """The clearance including that of the near finger."""


@dataclass
class _GraspsAtPose:
    """What depends only on the pose of a body, the ground and the robot."""

    pose: Pose
    candidates: list[GraspCandidate] | None = None
    tools: dict[GraspCandidate, Pose] = field(default_factory=dict)


class GraspSelector:
    """Compares the grasps of the pieces of a structure, in the present scene.

    Args:
        structure: the pieces.
        robot: the robot.
        terrain: the ground.
        limits: limits of an action; a gripper that cannot turn grasps at yaw 0.
        finger_opening: opening of the fingers before a pick, 0 to 1.
    """

    def __init__(
        self,
        structure: Structure,
        robot: Robot,
        terrain: Terrain,
        limits: ActionLimits,
        finger_opening: float,
    ) -> None:
        self.structure = structure
        self.robot = robot
        self.terrain = terrain
        self.limits = limits
        self.finger_opening = finger_opening
        self._at_pose: dict[Body, _GraspsAtPose] = {}

    def on_new_decision(self) -> None:
        """Prepare for a scene whose ground may have changed since the last call."""
        self._at_pose.clear()

    def yaws(self, body: Body) -> list[float]:
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
        candidates = [GraspCandidate(yaw_rad)]
        return self.clearances_m(body, candidates, self.others(body), position)[0]

    def candidates(self, body: Body) -> list[GraspCandidate]:
        """Return the grasps of a body, the centred ones first.

        A body on a slope is grasped along the normal of its side, as far as the arm can reach.
        """
        known = self._known(body)
        if known.candidates is None:
            known.candidates = self._new_candidates(body)
        return known.candidates

    def _known(self, body: Body) -> _GraspsAtPose:
        """Return what is known about the grasps of a body at its present pose."""
        pose, known = body.pose, self._at_pose.get(body)
        if known is None or known.pose != pose:
            known = self._at_pose[body] = _GraspsAtPose(pose)
        return known

    def _new_candidates(self, body: Body) -> list[GraspCandidate]:
        piece = self.structure.planner.pieces[body]
        candidates = [GraspCandidate(yaw) for yaw in self.yaws(body)]
        if self.limits.can_tilt and piece.tilt_rad(body) >= LEVEL_RAD:
            tools = tilted_tools(piece, body)
            candidates = [GraspCandidate(quaternion_yaw(tool), tool=tool) for tool in tools]
        if self.limits.can_tilt:
            candidates = [
                candidate._replace(middle_m=_middle_m(body, candidate)) for candidate in candidates
            ]
        centered = tuple(candidates)
        if self.limits.can_tilt and len(piece.grasp_yaws_rad) == 1:
            yaw = piece.grasp_yaws_rad[0]
            length_m = np.ptp(body.shape.vertices[:, :2] @ (-math.sin(yaw), math.cos(yaw)))
            candidates += [
                candidate._replace(along_m=float(share * length_m))
                for share in LENGTH_SHARES
                for candidate in centered
            ]
        # Edge grasps are for a gripper that cannot turn, and for slopes beside a body. On another
        # body, the grasped one would drag its support along.
        if (self.limits.can_tilt or not self.limits.turn_rad) and self._is_on_ground(body):
            gripper, opening = self.robot.gripper, self.finger_opening
            for candidate in centered:
                for side, edge in zip(
                    (1, -1), edge_grasps(gripper, body, candidate.yaw_rad, opening), strict=False
                ):
                    if candidate.tool is None:
                        candidates.append(edge)
                    else:
                        candidates.append(
                            candidate._replace(shift_m=side * edge.shift_m, middle_m=0.0)
                        )
        return candidates

    def is_free(self, body: Body) -> bool:
        """Whether a grasp of a body has clearance and, with tilts, is within reach."""
        best = self.best(body)
        if self.quality(body, best)[2] <= 0:
            return False
        if not self.limits.can_tilt:
            return True
        tool = self.tool_pose(body, best)
        is_grasp = best in self.candidates(body)
        return is_grasp and is_reachable(self.robot, self.terrain.support_ids, tool)

    def best(self, body: Body) -> GraspCandidate:
        """Return the best grasp of a body; with tilts, the best of those that the arm reaches.

        If it reaches none of them, it pushes a tilted body with fingers that point straight down.
        """
        candidates = self.candidates(body)
        qualities = self._qualities(body, candidates)
        order = sorted(range(len(candidates)), key=qualities.__getitem__, reverse=True)
        ranked = [candidates[i] for i in order]
        if not self.limits.can_tilt:
            return ranked[0]
        supports = self.terrain.support_ids
        vertical = (GraspCandidate(yaw) for yaw in self.yaws(body))
        return next(
            (
                candidate
                for candidate in (*ranked, *vertical)
                if is_reachable(self.robot, supports, self.tool_pose(body, candidate))
            ),
            ranked[0],
        )

    def _is_on_ground(self, body: Body) -> bool:
        return self.terrain.gap_below_m(body) < self.structure.block_m / 4

    def quality(self, body: Body, candidate: GraspCandidate) -> Quality:
        """Return the quality of a grasp, by which grasps are compared."""
        return self._qualities(body, [candidate])[0]

    def _qualities(self, body: Body, candidates: Sequence[GraspCandidate]) -> list[Quality]:
        """Return the quality of each grasp of a body."""
        others = self.others(body)
        limit_m = RAISE_BLOCKS * self.structure.block_m
        is_raised = [
            self.limits.can_tilt and self._raise_m(body, candidate) > limit_m
            for candidate in candidates
        ]
        lower = [c for c, raised in zip(candidates, is_raised, strict=True) if not raised]
        clearances_m = iter(self.clearances_m(body, lower, others, None))
        qualities = []
        for candidate, raised in zip(candidates, is_raised, strict=True):
            if raised:
                qualities.append(Quality(-1.0, 0.0, -1.0))
                continue
            clearance_m = least_m = next(clearances_m)
            if candidate.shift_m:
                gripper, yaw = self.robot.gripper, candidate.yaw_rad
                near = (candidate.near_finger_range_m,)
                least_m = min(clearance_m, path_clearance_m(gripper, body, yaw, near, others))
            if candidate.tool is not None:  # the largest tilt with enough clearance comes first
                least_m = min(least_m, SUFFICIENT_CLEARANCE_M)
            centering_m = -abs(candidate.along_m) - bool(candidate.shift_m)
            qualities.append(Quality(min(clearance_m, 0.0), centering_m, least_m))
        return qualities

    def tool_pose(self, body: Body, candidate: GraspCandidate) -> Pose:
        """Return the pose of the tool for a grasp, raised so that the fingers clear the ground."""
        tools = self._known(body).tools
        if candidate not in tools:
            tools[candidate] = self._new_tool_pose(body, candidate)
        return tools[candidate]

    def _new_tool_pose(self, body: Body, candidate: GraspCandidate) -> Pose:
        x, y, z = _tool_position(body.position, candidate)
        rotation = None if candidate.tool is None else quaternion_matrix(candidate.tool)
        lowest = self.terrain.lowest_tool_m(self.robot.gripper, (x, y), rotation)
        if candidate.tool is None:
            return downward_pose((x, y, max(z, lowest)), candidate.yaw_rad)
        return Pose((x, y, max(z, lowest)), candidate.tool)

    def _raise_m(self, body: Body, candidate: GraspCandidate) -> float:
        """Return the height by which a grasp is raised so that the fingers clear the ground."""
        at = _tool_position(body.position, candidate)
        return self.tool_pose(body, candidate).position[2] - at[2]

    def clearances_m(
        self,
        body: Body,
        candidates: Sequence[GraspCandidate],
        others: Sequence[Body],
        position: Vector | None,
    ) -> list[float]:
        """Return the clearances between the hand, opened around a body, and some other bodies.

        Of an edge grasp only the far finger counts.

        Args:
            body: the body.
            candidates: the grasps.
            others: the other bodies; those beyond the reach of the hand do not count.
            position: assumed position of the body; its present one if None.
        """
        at = body.position if position is None else position
        grasps = [_tool_position(at, candidate) for candidate in candidates]
        extent_m = math.hypot(*self.robot.hand_half_extents_m) + SUFFICIENT_CLEARANCE_M
        clearances_m = [math.inf] * len(candidates)
        for other in others:
            center, reach_m = other.position[:2], extent_m + footprint_radius_m(other)
            near = [i for i, grasp in enumerate(grasps) if math.dist(center, grasp[:2]) < reach_m]
            tilted = [i for i in near if candidates[i].tool is not None]
            found = {
                i: self._vertical_clearance_m(body, candidates[i], grasps[i], other, at)
                for i in near
                if candidates[i].tool is None
            }
            if tilted:
                tools = [Pose(grasps[i], candidates[i].tool) for i in tilted]
                gaps_m = tool_clearances_m(
                    self.robot, tools, [other], self.finger_opening, with_knuckles=True
                )
                found |= zip(tilted, gaps_m.tolist(), strict=True)
            for i, gap_m in found.items():
                clearances_m[i] = min(clearances_m[i], gap_m)
        return clearances_m

    def _vertical_clearance_m(
        self, body: Body, candidate: GraspCandidate, grasp: Vector, other: Body, at: Vector
    ) -> float:
        """Return the clearance of a tool that points straight down from another body.

        Args:
            body: the body.
            candidate: the grasp.
            grasp: position of the tool.
            other: the other body.
            at: position of the body.
        """
        gripper, yaw = self.robot.gripper, candidate.yaw_rad
        if candidate.shift_m:
            far = (candidate.far_finger_range_m,)
            fingers = path_clearance_m(gripper, body, yaw, far, [other], at)
        else:
            fingers = grasp_clearance_m(gripper, body, yaw, [other], self.finger_opening, grasp)
        x, y, z = grasp
        return min(fingers, hand_clearance_m(self.robot, PlanarFrame(x, y, yaw), z, [other]))

    def others(self, body: Body) -> list[Body]:
        """Return the other pieces."""
        return [other for other in self.structure.pieces if other is not body]


def _tool_position(position: Vector, candidate: GraspCandidate) -> Vector:
    """Return the position of the tool for a grasp of a body at a position."""
    across, along = _tool_offsets(candidate)
    return tuple(p + a + b for p, a, b in zip(position, across, along, strict=True))


@lru_cache(maxsize=1024)
def _tool_offsets(candidate: GraspCandidate) -> tuple[Vector, Vector]:
    """Return the offsets of the tool from a body's origin along and perpendicular to the closing
    axis, in the world frame; of a tilted tool, their sum and zero."""
    across_m, along_m = candidate.shift_m + candidate.middle_m, candidate.along_m
    if candidate.tool is None:
        cos, sin = math.cos(candidate.yaw_rad), math.sin(candidate.yaw_rad)
        return (cos * across_m, sin * across_m, 0.0), (-sin * along_m, cos * along_m, 0.0)
    offset = (across_m, -along_m, 0.0)  # the y axis of a tool is reversed
    return Pose((0.0, 0.0, 0.0), candidate.tool).compose(Pose(offset)).position, (0.0, 0.0, 0.0)


def _middle_m(body: Body, candidate: GraspCandidate) -> float:
    """Return the middle of a body along the closing axis, relative to its origin."""
    yaw = candidate.yaw_rad
    axis = (math.cos(yaw), math.sin(yaw), 0.0)
    if candidate.tool is not None:
        axis = tuple(row[0] for row in quaternion_matrix(candidate.tool))
    distances = (world_vertices(body) - body.position) @ axis
    return float(distances.min() + distances.max()) / 2
