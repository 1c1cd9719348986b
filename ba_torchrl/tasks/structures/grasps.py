"""Grasps of the pieces of a structure: which one, how much clearance it has, and what blocks it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body, footprint_radius_m, vertical_extent, world_vertices
from ba_torchrl.sim.geometry import (
    IDENTITY,
    PlanarFrame,
    Pose,
    Quaternion,
    Vector,
    downward_pose,
    quaternion_matrix,
    quaternion_yaw,
)
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.robots.gripper import Gripper
from ba_torchrl.tasks.manipulation.clearance import (
    grasp_clearance_m,
    hand_clearance_m,
    path_clearance_m,
    tool_clearances_m,
)
from ba_torchrl.tasks.manipulation.commands import LEVEL_RAD
from ba_torchrl.tasks.manipulation.grasps import is_reachable
from ba_torchrl.tasks.structures.blueprint import Piece
from ba_torchrl.tasks.structures.free_space import extent_along_m
from ba_torchrl.tasks.structures.structure import Structure
from ba_torchrl.tasks.structures.tilts import in_resting_frame, tilted_tools
from ba_torchrl.tasks.workspace import ActionLimits

EDGE_CLEARANCE_M = 2e-3
"""Clearance between a piece and the finger that descends close to it."""
RAISE_BLOCKS = 0.3
"""Largest height, in blocks, by which a grasp is raised so that the fingers clear the ground."""
LENGTH_SHARES = (-0.1, 0.1, -0.2, 0.2, -0.3, 0.3)
"""Positions of grasps off the centre of a long piece, as a multiple of its length."""
SUFFICIENT_CLEARANCE_M = 0.02
"""Clearances above this are equally good."""
SITE_GAP_M = 0.01
"""Gap wanted between a structure and the hand that picks a piece beside it."""
DEFICIT_WEIGHT = 10.0
"""Cost of a metre of missing clearance, as a multiple of the cost of a metre of distance."""
BLOCKED_COST_M = 0.05
"""Cost of a pick without clearance, in open loop."""
CLOSE_LOOP_BLOCKED_COST_M = 1.0
"""Cost of picking a piece whose grasps all lack clearance, in close loop."""
PUSHED_M = 0.16
"""Largest distance by which a finger that descends between two blocks pushes one of them."""


class Move(NamedTuple):
    """A piece to pick, and where to place it."""

    body: Body
    piece: Piece
    position: Vector
    """Final position of its origin."""
    yaw_rad: float | None
    """Final yaw up to multiples of the period; None if any yaw is allowed."""
    yaw_period_rad: float
    onto: tuple[Body, ...]
    """The bodies that will support it; empty for the ground."""
    surface: Quaternion = IDENTITY
    """Orientation of a frame whose z axis is the normal of the surface that will support it."""


class GraspCandidate(NamedTuple):
    """A grasp of a piece; distances are from its origin along the gripper's x axis."""

    yaw_rad: float
    shift_m: float = 0.0
    """Position of the tool; 0 for a centred grasp."""
    far_finger_range_m: tuple[float, float] = (0.0, 0.0)
    """Range that the far finger sweeps as it closes, for a grasp with a shift."""
    near_finger_range_m: tuple[float, float] = (0.0, 0.0)
    """Range in which the near finger descends beside the piece, for a grasp with a shift."""
    middle_m: float = 0.0
    """Middle of the piece, at which a centred grasp has the same space for both fingers."""
    along_m: float = 0.0
    """Position of the tool perpendicular to the closing axis, along the length of the piece."""
    tool: Quaternion | None = None
    """Orientation of a tilted tool; None for a tool that points straight down."""


class Quality(NamedTuple):
    """Quality of a grasp; a larger one is better."""

    deficit_m: float
    """The clearance if it is negative, else 0."""
    centering_m: float
    """How close the grasp is to the centre, at most 0."""
    clearance_m: float
    """The clearance including that of the near finger."""


class Grasps:
    """The grasps of the pieces in the present scene; by default every grasp is free."""

    clears_blocked_pieces: bool = False
    """Whether pieces that block the grasp of another piece are removed."""

    def rise_m(self, body: Body) -> float:
        """Return the height of a piece's origin above its support when it is released."""
        return body.position[2] - vertical_extent(body)[0]

    def pick_cost_m(self, body: Body) -> float:
        """Return the cost of picking a piece, as a distance that is added to that of its move."""
        return 0.0

    def site_deficit_m(self, sites: np.ndarray, rest: Sequence[Body]) -> np.ndarray:
        """Return the clearance [S] that structures at sites lack for picking the remaining pieces.

        Args:
            sites: [S, P, 2] points of the ground that a structure at each site occupies, metres.
            rest: the pieces that remain to be picked.
        """
        return np.zeros(len(sites))

    def blocks_grasp(self, body: Body, other: Body, position: Vector | None) -> Sequence[bool]:
        """Return for each grasp candidate of a piece whether another piece blocks it.

        Args:
            position: assumed position of the other piece; its present one if None.
        """
        return (False,)


class PickPlaceGrasps(Grasps):
    """The grasps of the open-loop expert, for one decision: it remembers them by their body.

    Args:
        limits: limits of an action; a gripper that cannot turn grasps at yaw 0.
        finger_opening: opening of the fingers before a pick, 0 to 1.
        clears_blocked_pieces: whether to remove pieces that block the grasp of another piece.
    """

    def __init__(
        self,
        structure: Structure,
        robot: Robot,
        limits: ActionLimits,
        *,
        finger_opening: float = 1.0,
        clears_blocked_pieces: bool = False,
    ) -> None:
        self.structure = structure
        self.robot = robot
        self.terrain = structure.terrain
        self.limits = limits
        self.finger_opening = finger_opening
        self.clears_blocked_pieces = clears_blocked_pieces
        self._candidates: dict[Body, list[GraspCandidate]] = {}
        self._tools: dict[tuple[Body, GraspCandidate], Pose] = {}

    def rise_m(self, body: Body) -> float:
        """Return the height of a piece's origin above its support when it is released.

        A gripper that can tilt releases it parallel to the support.
        """
        if not self.limits.can_tilt:
            return super().rise_m(body)
        rows = quaternion_matrix(in_resting_frame(self.structure.pieces[body], body))
        return -float((body.shape.vertices @ rows[2]).min())

    def pick_cost_m(self, body: Body) -> float:
        """Return the cost of a pick: 0 with clearance, else more the more clearance is missing.

        A grasp that pushes a neighbour costs the distance by which that leaves the workspace.
        """
        candidate = self.best(body)
        deficit_m, _, clearance_m = self.quality(body, candidate)
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
        """Return the clearance [S] that hand and load lack when they pick the remaining pieces."""
        if not rest:
            return np.zeros(len(sites))
        # rectangles around each piece: the hand at its first and last yaw, and the piece itself
        centers = np.array([other.position[:2] for other in rest])
        yaws, halves = [], []
        for other in rest:
            own_yaws = self.yaws(other)
            low, high = other.shape.bounds_m
            load = tuple(max(-a, b) for a, b in zip(low[:2], high[:2], strict=True))
            own_yaw = self.structure.pieces[other].yaw_rad(other)
            yaws.append([own_yaws[0], own_yaws[-1], own_yaw])
            halves.append([self.robot.hand_half_extents_m, self.robot.hand_half_extents_m, load])
        x, y = np.moveaxis(sites[:, :, None] - centers, 3, 0)[..., None]  # [S, P, rest, 1]
        cos, sin = np.cos(yaws), np.sin(yaws)
        half_along, half_across = np.moveaxis(np.array(halves), 2, 0)
        along, across = np.abs(x * cos + y * sin), np.abs(y * cos - x * sin)
        gaps = np.maximum(along - half_along, across - half_across).min(axis=1)  # [S, rest, 3]
        gaps = np.minimum(gaps[:, :, :2].max(axis=2), gaps[:, :, 2])
        return np.maximum(SITE_GAP_M + self.structure.block_m / 2 - gaps, 0.0).sum(axis=1)

    def blocks_grasp(self, body: Body, other: Body, position: Vector | None) -> list[bool]:
        """Return for each grasp candidate of a body whether another piece blocks it."""
        at = body.position
        if position is not None:  # the body is displaced instead of the other piece
            coordinates = zip(at, other.position, position, strict=True)
            at = tuple(a + b - c for a, b, c in coordinates)
        candidates = self.candidates(body)
        return [gap_m <= 0 for gap_m in self.clearances_m(body, candidates, [other], at)]

    def yaws(self, body: Body) -> list[float]:
        """Return the yaws of the gripper at which it can grasp a body."""
        if not self.limits.turn_rad:
            return [0.0]
        return self.structure.pieces[body].grasp_yaws(body)

    def clearance_m(self, body: Body, yaw_rad: float, position: Vector | None = None) -> float:
        """Return the clearance between the hand, opened around a body, and the other pieces.

        Args:
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
        if body not in self._candidates:
            self._candidates[body] = self._new_candidates(body)
        return self._candidates[body]

    def _new_candidates(self, body: Body) -> list[GraspCandidate]:
        piece = self.structure.pieces[body]
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
        has_edge_grasps = self.limits.can_tilt or not self.limits.turn_rad
        if has_edge_grasps and self.terrain.gap_below_m(body) < self.structure.block_m / 4:
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
        key = body, candidate
        if key not in self._tools:
            self._tools[key] = self._new_tool_pose(body, candidate)
        return self._tools[key]

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
                gaps_m = tool_clearances_m(self.robot, tools, [other], self.finger_opening)
                found |= zip(tilted, gaps_m.tolist(), strict=True)
            for i, gap_m in found.items():
                clearances_m[i] = min(clearances_m[i], gap_m)
        return clearances_m

    def _vertical_clearance_m(
        self, body: Body, candidate: GraspCandidate, grasp: Vector, other: Body, at: Vector
    ) -> float:
        """Return the clearance of a tool that points straight down from another body.

        Args:
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


class CloseLoopGrasps(Grasps):
    """The grasps of the close-loop expert: the nearest piece first, those with a free grasp before
    all others.

    Args:
        limits: limits of an action; a gripper that cannot turn keeps its yaw.
    """

    def __init__(self, structure: Structure, robot: Robot, limits: ActionLimits) -> None:
        self.structure = structure
        self.robot = robot
        self.limits = limits

    def yaws(self, body: Body) -> list[float]:
        """Return the yaws of the gripper at which it can grasp a body."""
        if not self.limits.turn_rad:
            return [self.robot.tool_pose()[1]]
        return self.structure.pieces[body].grasp_yaws(body)

    def pick_cost_m(self, body: Body) -> float:
        """Return the distance of a piece from the tool, and a cost if its grasps are blocked."""
        others = [other for other in self.structure.pieces if other is not body]
        clearance_m = max(
            grasp_clearance_m(self.robot.gripper, body, yaw, others) for yaw in self.yaws(body)
        )
        distance_m = math.dist(self.robot.tool_pose()[0][:2], body.position[:2])
        return distance_m + (0.0 if clearance_m > 0 else CLOSE_LOOP_BLOCKED_COST_M)


class GraspBlocking:
    """Which pieces block the grasps of which others.

    Args:
        bodies_above: for each body all that it supports, directly or through others.
        held: the body in the gripper; it blocks no grasp.
    """

    def __init__(
        self,
        pieces: Mapping[Body, Piece],
        bodies_above: Mapping[Body, frozenset[Body]],
        held: Body | None,
        grasps: Grasps,
    ) -> None:
        self.pieces = pieces
        self.bodies_above = bodies_above
        self.held = held
        self.grasps = grasps
        self._obstacles: dict[Body, list[frozenset[Body]]] = {}

    def obstacles(self, body: Body) -> list[frozenset[Body]]:
        """Return for each grasp candidate of a body the pieces that block it."""
        if not self.grasps.clears_blocked_pieces:
            return [frozenset()]
        if body not in self._obstacles:
            others = [other for other in self.pieces if other is not body]
            rows = [self.grasps.blocks_grasp(body, other, None) for other in others]
            self._obstacles[body] = [
                frozenset(
                    other
                    for other, is_blocking in zip(others, column, strict=True)
                    if is_blocking and other is not self.held
                )
                for column in zip(*rows, strict=True)
            ] or [frozenset()]
        return self._obstacles[body]

    def removals(self, assignment: Sequence[Body | None]) -> Iterator[tuple[int, Body, None]]:
        """Yield the pieces to place on the ground to free the grasp of another piece.

        Args:
            assignment: the body in each slot; these pieces are not picked.

        Yields:
            Number of pieces to remove, the piece to remove first, and None for the ground.
        """
        for body in self.pieces:
            if body not in assignment and body is not self.held:
                removed = self._fewest_removals(body) or ()
                for top in removed:
                    if self.bodies_above[top].isdisjoint(removed):
                        yield len(removed), top, None

    def added_removals(self, move: Move, assignment: Sequence[Body | None]) -> int:
        """Return the number of moves that a move adds, as its piece blocks others.

        Args:
            assignment: the body in each slot; these pieces are not picked.
        """
        if not self.grasps.clears_blocked_pieces:
            return 0
        after, most = self._after(move), 0
        for other in self.pieces:
            if other in assignment or other is move.body or other is self.held:
                continue
            removed = after._fewest_removals(other)
            if removed is None and self._fewest_removals(other) is not None:
                most = len(self.pieces)
            elif removed is not None and move.body in removed:
                most = max(most, len(removed))
        return most + 2 if most else 0  # the piece is removed and placed again

    def _fewest_removals(self, body: Body) -> frozenset[Body] | None:
        """Return the smallest set of pieces whose removal frees a grasp of a body; None if none is.

        Each of them has a grasp that only pieces of the set block.
        """
        found = []
        for obstacles in self.obstacles(body):
            removed = obstacles.union(*(self.bodies_above[other] for other in obstacles))
            if body not in removed and all(
                any(others <= removed for others in self.obstacles(other)) for other in removed
            ):
                found.append(removed)
        return min(found, key=len, default=None)

    def _after(self, move: Move) -> GraspBlocking:
        """Return the blocking after a move; the moved piece itself counts as free to grasp."""
        body, bodies_above = move.body, dict(self.bodies_above)
        for other, above in self.bodies_above.items():
            if other in move.onto or not above.isdisjoint(move.onto):
                bodies_above[other] = above | {body}
        held = None if self.held is body else self.held
        after = GraspBlocking(self.pieces, bodies_above, held, self.grasps)
        for other in self.pieces:
            if other is body:
                after._obstacles[other] = [frozenset()]
                continue
            blocks = self.grasps.blocks_grasp(other, body, move.position)
            after._obstacles[other] = [
                obstacles | {body} if is_blocking else obstacles - {body}
                for obstacles, is_blocking in zip(self.obstacles(other), blocks, strict=True)
            ]
        return after


def edge_grasps(
    gripper: Gripper, body: Body, yaw_rad: float, opening: float = 1.0
) -> list[GraspCandidate]:
    """Return the grasps at which one finger descends close to a body and the other far from it.

    The near finger needs no more clearance than its own depth. Even with less the grasp may
    succeed, as the body can slide into the gap between the fingers.

    Args:
        body: a body on the ground, on which it can slide.
        yaw_rad: yaw of the gripper, up to half a turn.

    Returns:
        One grasp for each finger; none if the body nearly fills the gap between the fingers.
    """
    half_gap_m = opening * gripper.half_gap_m
    finger_m = gripper.finger_depth_m
    candidates = []
    for yaw in (yaw_rad, yaw_rad + math.pi):
        ahead = np.array([math.cos(yaw), math.sin(yaw)])
        far_m, near_m = extent_along_m(body, np.stack([ahead, -ahead])).tolist()
        shift_m = half_gap_m - near_m - EDGE_CLEARANCE_M
        if shift_m > EDGE_CLEARANCE_M:
            far_finger_range_m = (far_m, shift_m + half_gap_m + finger_m)
            near_finger_range_m = (-near_m - EDGE_CLEARANCE_M - finger_m, -near_m)
            candidates.append(GraspCandidate(yaw, shift_m, far_finger_range_m, near_finger_range_m))
    return candidates


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
