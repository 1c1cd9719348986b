"""Grasps of the pieces of a structure in open loop: which there are, and how good each is."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body, footprint_radius_m, world_vertices
from ba_torchrl.sim.geometry import (
    ORIGIN,
    PlanarFrame,
    Pose,
    Quaternion,
    Vector,
    downward_quaternion,
    quaternion_matrix,
    quaternion_yaw,
)
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.robots.gripper import Gripper
from ba_torchrl.tasks.manipulation.clearance import grasp_clearance_m, path_clearance_m
from ba_torchrl.tasks.manipulation.hand_clearance import hand_clearance_m, tool_clearances_m
from ba_torchrl.tasks.manipulation.pick_place_commands import LEVEL_RAD
from ba_torchrl.tasks.manipulation.top_down_grasps import is_reachable
from ba_torchrl.tasks.structures.free_space import extent_along_m
from ba_torchrl.tasks.structures.moves import DEFICIT_WEIGHT, Grasps
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
BLOCKED_COST_M = 0.05
"""Cost of a pick without clearance."""
PUSHED_M = 0.16
"""Largest distance by which a finger that descends between two blocks pushes one of them."""


@dataclass(frozen=True)
class Centred:
    """The tool points straight down, and both fingers have the same space beside the piece."""

    yaw_rad: float
    across_m: float = 0.0
    """Position of the tool along the closing axis, from the origin of the piece."""
    along_m: float = 0.0
    """Position of the tool along the length of the piece, from its origin."""
    is_shifted: ClassVar[bool] = False

    @property
    def centering_m(self) -> float:
        """How close the grasp is to the centre of the piece, at most 0."""
        return -abs(self.along_m) - self.is_shifted

    @property
    def orientation(self) -> Quaternion:
        """Orientation of the tool."""
        return downward_quaternion(self.yaw_rad)

    def tool_position(self, position: Vector) -> Vector:
        """Return the position of the tool for a piece at a position."""
        x, y, z = position
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        x, y = x + cos * self.across_m, y + sin * self.across_m
        return x - sin * self.along_m, y + cos * self.along_m, z


@dataclass(frozen=True, kw_only=True)
class Shifted(Centred):
    """The tool points straight down, and one finger descends close beside the piece.

    Ranges are along the gripper's x axis, from the origin of the piece.
    """

    far_finger_range_m: tuple[float, float]
    """Range that the far finger sweeps as it closes."""
    near_finger_range_m: tuple[float, float]
    """Range in which the near finger descends."""
    is_shifted: ClassVar[bool] = True


@dataclass(frozen=True)
class Tilted:
    """The tool is tilted, as the piece lies on a slope."""

    orientation: Quaternion
    """Orientation of the tool."""
    across_m: float = 0.0
    """Position of the tool along the closing axis, from the origin of the piece."""
    along_m: float = 0.0
    """Position of the tool along the length of the piece, from its origin."""
    is_shifted: bool = False
    """Whether one finger is close to the piece, instead of both at the same distance."""

    @property
    def yaw_rad(self) -> float:
        """Heading of the closing axis."""
        return quaternion_yaw(self.orientation)

    @property
    def centering_m(self) -> float:
        """How close the grasp is to the centre of the piece, at most 0."""
        return -abs(self.along_m) - self.is_shifted

    @cached_property
    def _offset(self) -> Vector:
        offset = (self.across_m, -self.along_m, 0.0)  # the y axis of a tool is reversed
        return Pose(ORIGIN, self.orientation).compose(Pose(offset)).position

    def tool_position(self, position: Vector) -> Vector:
        """Return the position of the tool for a piece at a position."""
        return tuple(p + o for p, o in zip(position, self._offset, strict=True))

    def upright(self) -> Centred:
        """Return the grasp at the same point with a tool that points straight down."""
        return Centred(self.yaw_rad, self.across_m, self.along_m)


Grasp = Centred | Shifted | Tilted


class Quality(NamedTuple):
    """Quality of a grasp; a larger one is better."""

    deficit_m: float
    """The clearance if it is negative, else 0."""
    centering_m: float
    """How close the grasp is to the centre, at most 0."""
    clearance_m: float
    """The clearance, the near finger's included."""


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
        self._candidates: dict[Body, list[Grasp]] = {}
        self._tools: dict[tuple[Body, Grasp], Pose] = {}

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
        grasp = self.attempt(body)
        deficit_m, _, clearance_m = self.quality(body, grasp)
        if clearance_m > 0:
            return 0.0
        cost_m = BLOCKED_COST_M - DEFICIT_WEIGHT * deficit_m
        if grasp.is_shifted and deficit_m == 0:
            x, y, _ = body.position
            end = PlanarFrame(x, y, grasp.yaw_rad).to_world(PUSHED_M, 0.0)
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
        at = body.position
        if position is not None:  # the body is displaced instead of the other piece
            coordinates = zip(at, other.position, position, strict=True)
            at = tuple(a + b - c for a, b, c in coordinates)
        return [gap_m <= 0 for gap_m in self.clearances_m(body, self.candidates(body), [other], at)]

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
        return self.clearances_m(body, [Centred(yaw_rad)], self.others(body), position)[0]

    def candidates(self, body: Body) -> list[Grasp]:
        """Return the grasps of a body, the centred ones first.

        A body on a slope is grasped along the normal of its side, as far as the arm can reach.
        """
        if body not in self._candidates:
            self._candidates[body] = self._new_candidates(body)
        return self._candidates[body]

    def _new_candidates(self, body: Body) -> list[Grasp]:
        piece = self.structure.pieces[body]
        centered: list[Centred | Tilted]
        if not self.limits.can_tilt:
            centered = [Centred(yaw) for yaw in self.yaws(body)]
        elif piece.tilt_rad(body) < LEVEL_RAD:
            centered = [Centred(yaw, _middle_m(body, yaw)) for yaw in self.yaws(body)]
        else:
            tools = tilted_tools(piece, body)
            centered = [Tilted(tool, _middle_m(body, tool)) for tool in tools]
        candidates: list[Grasp] = list(centered)
        if self.limits.can_tilt and len(piece.grasp_yaws_rad) == 1:
            yaw = piece.grasp_yaws_rad[0]
            length_m = np.ptp(body.shape.vertices[:, :2] @ (-math.sin(yaw), math.cos(yaw)))
            candidates += [
                replace(grasp, along_m=float(share * length_m))
                for share in LENGTH_SHARES
                for grasp in centered
            ]
        # Edge grasps are for a gripper that cannot turn, and for slopes beside a body. On another
        # body, the grasped one would drag its support along.
        has_edge_grasps = self.limits.can_tilt or not self.limits.turn_rad
        if has_edge_grasps and self.terrain.gap_below_m(body) < self.structure.block_m / 4:
            for grasp in centered:
                edges = edge_grasps(self.robot.gripper, body, grasp.yaw_rad, self.finger_opening)
                if isinstance(grasp, Centred):
                    candidates += edges
                else:
                    candidates += [
                        Tilted(grasp.orientation, side * edge.across_m, is_shifted=True)
                        for side, edge in zip((1, -1), edges, strict=False)
                    ]
        return candidates

    def is_free(self, body: Body) -> bool:
        """Whether a grasp of a body has clearance and, with tilts, is within reach."""
        best = self.best(body)
        return best is not None and self.quality(body, best).clearance_m > 0

    def best(self, body: Body) -> Grasp | None:
        """Return the best grasp of a body; with tilts, of those that the arm reaches, if any."""
        ranked = self._ranked(body)
        return self._first_reachable(body, ranked) if self.limits.can_tilt else ranked[0]

    def attempt(self, body: Body) -> Grasp:
        """Return the best grasp of a body, or what comes closest to it where there is none.

        Fingers that point straight down push a tilted body to where the arm reaches a grasp.
        """
        vertical = map(Centred, self.yaws(body))
        return self.best(body) or self._first_reachable(body, vertical) or self._ranked(body)[0]

    def _ranked(self, body: Body) -> list[Grasp]:
        """Return the grasps of a body, the best first."""
        candidates = self.candidates(body)
        qualities = self._qualities(body, candidates)
        order = sorted(range(len(candidates)), key=qualities.__getitem__, reverse=True)
        return [candidates[i] for i in order]

    def _first_reachable(self, body: Body, grasps: Iterable[Grasp]) -> Grasp | None:
        supports = self.terrain.support_ids
        tools = ((grasp, self.tool_pose(body, grasp)) for grasp in grasps)
        return next((g for g, tool in tools if is_reachable(self.robot, supports, tool)), None)

    def quality(self, body: Body, grasp: Grasp) -> Quality:
        """Return the quality of a grasp, by which grasps are compared."""
        return self._qualities(body, [grasp])[0]

    def _qualities(self, body: Body, grasps: Sequence[Grasp]) -> list[Quality]:
        """Return the quality of each grasp of a body."""
        others, gripper = self.others(body), self.robot.gripper
        limit_m = RAISE_BLOCKS * self.structure.block_m
        lower = [
            grasp
            for grasp in grasps
            if not self.limits.can_tilt or self._raise_m(body, grasp) <= limit_m
        ]
        qualities = dict.fromkeys(grasps, Quality(-1.0, 0.0, -1.0))  # those that are raised more
        clearances_m = self.clearances_m(body, lower, others, None)
        for grasp, clearance_m in zip(lower, clearances_m, strict=True):
            least_m = clearance_m
            if grasp.is_shifted:
                near_m = (0.0, 0.0)  # of a tilted tool, the origin of the piece
                if isinstance(grasp, Shifted):
                    near_m = grasp.near_finger_range_m
                path_m = path_clearance_m(gripper, body, grasp.yaw_rad, (near_m,), others)
                least_m = min(clearance_m, path_m)
            if isinstance(grasp, Tilted):  # the largest tilt with enough clearance comes first
                least_m = min(least_m, SUFFICIENT_CLEARANCE_M)
            qualities[grasp] = Quality(min(clearance_m, 0.0), grasp.centering_m, least_m)
        return [qualities[grasp] for grasp in grasps]

    def tool_pose(self, body: Body, grasp: Grasp) -> Pose:
        """Return the pose of the tool for a grasp, raised so that the fingers clear the ground."""
        key = body, grasp
        if key not in self._tools:
            x, y, z = grasp.tool_position(body.position)
            is_tilted = isinstance(grasp, Tilted)
            rotation = quaternion_matrix(grasp.orientation) if is_tilted else None
            lowest = self.terrain.lowest_tool_m(self.robot.gripper, (x, y), rotation)
            self._tools[key] = Pose((x, y, max(z, lowest)), grasp.orientation)
        return self._tools[key]

    def _raise_m(self, body: Body, grasp: Grasp) -> float:
        """Return the height by which a grasp is raised so that the fingers clear the ground."""
        at = grasp.tool_position(body.position)
        return self.tool_pose(body, grasp).position[2] - at[2]

    def clearances_m(
        self,
        body: Body,
        grasps: Sequence[Grasp],
        others: Sequence[Body],
        position: Vector | None,
    ) -> list[float]:
        """Return the clearances between the hand, opened around a body, and some other bodies.

        Of a shifted grasp only the far finger counts.

        Args:
            others: the other bodies; those beyond the reach of the hand do not count.
            position: assumed position of the body; its present one if None.
        """
        at = body.position if position is None else position
        tools = [grasp.tool_position(at) for grasp in grasps]
        extent_m = math.hypot(*self.robot.hand_half_extents_m) + SUFFICIENT_CLEARANCE_M
        clearances_m = [math.inf] * len(grasps)
        for other in others:
            center, reach_m = other.position[:2], extent_m + footprint_radius_m(other)
            near = [i for i, tool in enumerate(tools) if math.dist(center, tool[:2]) < reach_m]
            tilted = [i for i in near if isinstance(grasps[i], Tilted)]
            found = {
                i: self._vertical_clearance_m(body, grasps[i], tools[i], other, at)
                for i in near
                if not isinstance(grasps[i], Tilted)
            }
            if tilted:
                poses = [Pose(tools[i], grasps[i].orientation) for i in tilted]
                gaps_m = tool_clearances_m(self.robot, poses, [other], self.finger_opening)
                found |= zip(tilted, gaps_m.tolist(), strict=True)
            for i, gap_m in found.items():
                clearances_m[i] = min(clearances_m[i], gap_m)
        return clearances_m

    def _vertical_clearance_m(
        self, body: Body, grasp: Centred | Shifted, tool: Vector, other: Body, at: Vector
    ) -> float:
        """Return the clearance of a tool that points straight down from another body.

        Args:
            tool: position of the tool.
            at: position of the body.
        """
        gripper, yaw = self.robot.gripper, grasp.yaw_rad
        if isinstance(grasp, Shifted):
            far_m = (grasp.far_finger_range_m,)
            fingers = path_clearance_m(gripper, body, yaw, far_m, [other], at)
        else:
            fingers = grasp_clearance_m(gripper, body, yaw, [other], self.finger_opening, tool)
        x, y, z = tool
        return min(fingers, hand_clearance_m(self.robot, PlanarFrame(x, y, yaw), z, [other]))

    def others(self, body: Body) -> list[Body]:
        """Return the other pieces."""
        return [other for other in self.structure.pieces if other is not body]


def edge_grasps(
    gripper: Gripper, body: Body, yaw_rad: float, opening: float = 1.0
) -> list[Shifted]:
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
    grasps = []
    for yaw in (yaw_rad, yaw_rad + math.pi):
        ahead = np.array([math.cos(yaw), math.sin(yaw)])
        far_m, near_m = extent_along_m(body, np.stack([ahead, -ahead])).tolist()
        shift_m = half_gap_m - near_m - EDGE_CLEARANCE_M
        if shift_m > EDGE_CLEARANCE_M:
            far_range_m = (far_m, shift_m + half_gap_m + finger_m)
            near_range_m = (-near_m - EDGE_CLEARANCE_M - finger_m, -near_m)
            grasps.append(
                Shifted(
                    yaw, shift_m, far_finger_range_m=far_range_m, near_finger_range_m=near_range_m
                )
            )
    return grasps


def _middle_m(body: Body, tool: float | Quaternion) -> float:
    """Return the middle of a body along the closing axis, relative to its origin.

    Args:
        tool: yaw of a tool that points straight down, or orientation of a tilted one.
    """
    if isinstance(tool, float):
        axis = (math.cos(tool), math.sin(tool), 0.0)
    else:
        axis = tuple(row[0] for row in quaternion_matrix(tool))
    distances = (world_vertices(body) - body.position) @ axis
    return float(distances.min() + distances.max()) / 2
