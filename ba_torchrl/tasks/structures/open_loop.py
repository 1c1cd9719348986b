"""What the open-loop tasks share that build something from pieces."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from ba_torchrl.actions import PickPlaceCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, Shape, radius_m, vertical_extent, world_vertices
from ba_torchrl.sim.geometry import PlanarFrame, Vector, downward_pose
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.base import Spot
from ba_torchrl.tasks.motion_primitives import finger_room
from ba_torchrl.tasks.open_loop_task import OpenLoopTask
from ba_torchrl.tasks.pick_place_commands import no_op, pick_command, place_command
from ba_torchrl.tasks.structures.blocking import GraspCandidate, edge_grasps, finger_way_room
from ba_torchrl.tasks.structures.blueprint import Blueprint, Piece
from ba_torchrl.tasks.structures.free_space import PlacementArea
from ba_torchrl.tasks.structures.planner import CROWDED, Move, StructurePlanner

START_GAP_M = 0.01
"""Least gap between the circles around two pieces at the start."""
HAND_OVER_TOOL_M = 0.018
"""What reaches higher than this above the tool point must keep clear of the whole hand."""
SITE_GAP_M = 0.01
"""Gap wanted between a structure and the hand that fetches a piece beside it."""
FREE_YAWS = 8
"""Yaws of a half turn that are tried where any will do."""
BLOCKED_M = 0.05
"""What it is worth in metres of way that the hand touches nothing else when it picks."""
DRIVEN_M = 0.16
"""A finger that wedges itself in between two blocks may drive one away by this much."""
AMPLE_M = 0.02
"""More room than this is no better."""


class Part(NamedTuple):
    """A piece of a structure: what it is in the blueprint, and in the world."""

    piece: Piece
    shape: Shape
    spot: Spot
    """Room that it gets at the start."""


class StructureTask(OpenLoopTask):
    """Pieces scattered on the floor; success when they stand as the blueprint says."""

    parameters = frozenset({"deconstruct"})
    tipping_ends: ClassVar[bool] = True
    """Whether a piece on its side, such as a roof, ends the episode."""
    clears_blocked_pieces: ClassVar[bool] = False
    """Whether the expert takes down what keeps the hand from a piece: worth it for blocks, beside
    long pieces it would go on for ever."""

    @abstractmethod
    def blueprint(self) -> Blueprint:
        """Return what is to be built."""

    @abstractmethod
    def parts(self) -> Sequence[Part]:
        """Return the pieces, those that need most room first."""

    def build(self, world: World) -> None:
        """Load the pieces."""
        self._parts = list(self.parts())
        self.bodies: list[Body] = []
        kinds: dict[str, list[Body]] = {}
        for part in self._parts:
            mates = kinds.setdefault(part.piece.kind, [])
            body = world.add(part.shape, f"{part.piece.kind} {len(mates) + 1}")
            mates.append(body)
            self.bodies.append(body)
        self.planner = StructurePlanner(self.blueprint(), world, kinds, self.block_m)

    def randomise(self, rng: np.random.Generator) -> None:
        """Put the pieces anywhere apart from each other.

        Fixed orientations are those at which a gripper that does not turn can grasp them.
        """
        spots, largest_radius_m = [], 0.0
        for part, body in zip(self._parts, self.bodies, strict=True):
            apart_m = (
                radius_m(body) + largest_radius_m + START_GAP_M
            )  # long pieces may lie end to end
            spots.append(part.spot._replace(distance_m=max(part.spot.distance_m, apart_m)))
            largest_radius_m = max(largest_radius_m, radius_m(body))
        points = self.random_points(rng, spots)
        for part, body, xy in zip(self._parts, self.bodies, points, strict=True):
            yaw = self.random_yaw(rng, 2 * math.pi) - part.piece.grasp_yaws_rad[0]
            self.stand(body, xy, yaw)

    def is_goal(self) -> bool:
        """Whether the structure stands, let go of."""
        return self.planner.is_built(self.robot.held_body())

    def is_valid(self) -> bool:
        """Whether all is inside the workspace, and nothing on its side that must not be."""
        if not super().is_valid():
            return False
        return not (self.tipping_ends and self.planner.has_tipped(self.robot.held_body()))

    @property
    def objects(self) -> Sequence[Body]:
        """The pieces."""
        return self.bodies

    def expert_command(self) -> PickPlaceCommand:
        """Move the piece that comes next, from any state."""
        held = self.robot.held_body()
        blocks_grasp = self._blocks_grasp if self.clears_blocked_pieces else None
        move = self.planner.next_move(
            self._placement_area(), held, self._effort, self._crowding, blocks_grasp
        )
        if move is None:
            return no_op(self.settings.workspace, held is not None)
        if move.body is held:
            return self._place(move)
        candidate = self._best_grasp(move.body)
        yaw, z = candidate.yaw_rad, move.body.position[2]
        x, y = _tool_point(move.body.position, candidate)
        lowest = self.settings.workspace.z[0] + self.lowest_pick_m
        return pick_command(downward_pose((x, y, max(z, lowest)), yaw))

    def pick_height_m(self, top_m: float) -> float:
        """Return the height of the tool for a pick.

        Between two pixels a ridge looks lower than it is, and closing fingers reach lower.
        """
        return max(super().pick_height_m(top_m), self.block_m / 2)

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the square searched for the highest point.

        A long piece may rest on what is far from its middle.
        """
        if held is None:
            return super().window_m(held)
        low, high = held.shape.bounds_m
        longest = max(high[0] - low[0], high[1] - low[1])
        return max(super().window_m(held), 0.375 * longest)

    # ----------------------------------------------------------------------------------------

    def _placement_area(self) -> PlacementArea:
        border = 1.5 * self.block_m
        (x0, x1), (y0, y1) = self.settings.workspace.x, self.settings.workspace.y
        return PlacementArea(
            (x0 + border, x1 - border),
            (y0 + border, y1 - border),
            2.0 * self.block_m,
            # fingers that do not turn close along x, on what lies along y
            line_yaw_rad=None if self.action_limits.turn_rad else math.pi / 2,
        )

    def grasp_yaws(self, body: Body) -> list[float]:
        """Return the yaws to grasp a body at; a gripper that does not turn has one."""
        if not self.action_limits.turn_rad:
            return [0.0]
        return self.planner.pieces[body].grasp_yaws(body)

    def room(self, body: Body, yaw_rad: float, at: Vector | None = None) -> float:
        """Return the gap between the hand, open around a body, and what stands beside it.

        It is infinite, or at least `AMPLE_M`, where nothing stands near.
        """
        others = [other for other in self.bodies if other is not body]
        return self._room_beside(body, GraspCandidate(yaw_rad), others, at)

    def _grasp_candidates(self, body: Body) -> list[GraspCandidate]:
        """Return the ways to grasp a body, the plain ones first."""
        candidates = [GraspCandidate(yaw) for yaw in self.grasp_yaws(body)]
        # with a turn there is another way; off the ground it would drag along what it lies on
        if not self.action_limits.turn_rad and self._is_on_ground(body):
            gripper, opening = self.robot.gripper, self.finger_opening
            for candidate in tuple(candidates):
                candidates += edge_grasps(gripper, body, candidate.yaw_rad, opening)
        return candidates

    def _best_grasp(self, body: Body) -> GraspCandidate:
        """Return the easiest way to grasp a body."""
        return max(self._grasp_candidates(body), key=lambda candidate: self._ease(body, candidate))

    def _is_on_ground(self, body: Body) -> bool:
        return vertical_extent(body)[0] < self.settings.surface_z_m + self.block_m / 4

    def _ease(self, body: Body, candidate: GraspCandidate) -> tuple[float, bool, float]:
        """Return how easy a way to grasp a body is.

        Returns:
            Metres that are wanting for it, negative; whether it is plain, which is best where
            nothing is; and the room, a finger that wedges itself in counted as well.
        """
        others = [other for other in self.bodies if other is not body]
        room = spare = self._room_beside(body, candidate, others, None)
        if candidate.shift_m:
            gripper, yaw = self.robot.gripper, candidate.yaw_rad
            spare = min(
                room, finger_way_room(gripper, body, yaw, candidate.near_finger_range_m, others)
            )
        return min(room, 0.0), not candidate.shift_m, spare

    def _room_beside(
        self, body: Body, candidate: GraspCandidate, others: Sequence[Body], at: Vector | None
    ) -> float:
        """Return the gap between the hand, open around a body, and some others."""
        at = body.position if at is None else at
        (x, y), z = _tool_point(at, candidate), at[2]
        extent = math.hypot(*self.robot.hand_half_m) + AMPLE_M
        others = [
            other
            for other in others
            if math.dist(other.position[:2], (x, y)) < extent + radius_m(other)
        ]
        yaw = candidate.yaw_rad
        if candidate.shift_m:
            room = finger_way_room(
                self.robot.gripper, body, yaw, candidate.far_finger_range_m, others, at
            )
        else:
            room = finger_room(self.robot, body, yaw, others, self.finger_opening, at)
        for other in others:
            corners = world_vertices(other)
            if corners[:, 2].max() > z + HAND_OVER_TOOL_M:
                local = np.stack(PlanarFrame(x, y, yaw).to_local(corners[:, 0], corners[:, 1]), 1)
                low, high = local.min(axis=0), local.max(axis=0)
                gaps = np.maximum(low, -high) - self.robot.hand_half_m
                room = min(room, float(gaps.max()))
        return room

    def _crowding(self, sites: np.ndarray, rest: Sequence[Body]) -> np.ndarray:
        """Return how much room is wanting at sites for the hand to fetch the rest, load and all.

        Args:
            sites: [S, P, 2] points that a structure will stand on.
            rest: what is to be fetched then.
        """
        if not rest:
            return np.zeros(len(sites))
        # as seen by each piece's hand, once for each yaw, and by its load
        centers = np.array([other.position[:2] for other in rest])
        yaws, halves = [], []
        for other in rest:
            grasps = self.grasp_yaws(other)
            low, high = other.shape.bounds_m
            load = tuple(max(-a, b) for a, b in zip(low[:2], high[:2], strict=True))
            yaws.append([grasps[0], grasps[-1], self.planner.pieces[other].yaw_rad(other)])
            halves.append([self.robot.hand_half_m, self.robot.hand_half_m, load])
        x, y = np.moveaxis(sites[:, :, None] - centers, 3, 0)[..., None]  # [S, P, rest, 1]
        cos, sin = np.cos(yaws), np.sin(yaws)
        half_along, half_across = np.moveaxis(np.array(halves), 2, 0)
        along, across = np.abs(x * cos + y * sin), np.abs(y * cos - x * sin)
        gaps = np.maximum(along - half_along, across - half_across).min(axis=1)  # [S, rest, 3]
        gaps = np.minimum(gaps[:, :, :2].max(axis=2), gaps[:, :, 2])
        return np.maximum(SITE_GAP_M + self.block_m / 2 - gaps, 0.0).sum(axis=1)

    def _blocks_grasp(self, body: Body, other: Body, place: Vector | None) -> list[bool]:
        """Return whether another piece is in the hand's way, for each way to grasp a body."""
        at = body.position
        if place is not None:  # as seen from there
            moved = zip(at, other.position, place, strict=True)
            at = tuple(a + b - c for a, b, c in moved)
        return [
            self._room_beside(body, candidate, [other], at) <= 0
            for candidate in self._grasp_candidates(body)
        ]

    def _effort(self, body: Body) -> float:
        """Prefer pieces that stand free, and of the others those that a wedge drives inwards."""
        candidate = self._best_grasp(body)
        lack_m, _, room_m = self._ease(body, candidate)
        if room_m > 0:
            return 0.0
        effort_m = BLOCKED_M - CROWDED * lack_m
        if candidate.shift_m and lack_m == 0:
            x, y, _ = body.position
            end = PlanarFrame(x, y, candidate.yaw_rad).to_world(DRIVEN_M, 0.0)
            spans = self.settings.workspace.x, self.settings.workspace.y
            effort_m += max(
                max(low - e, e - high, 0.0) for e, (low, high) in zip(end, spans, strict=True)
            )
        return effort_m

    def _place(self, move: Move) -> PickPlaceCommand:
        """Return the place that brings what is held to where it goes."""
        tool, held = self.robot.tool_transform(), move.body.pose
        yaw = tool.yaw_rad
        if not self.action_limits.turn_rad:
            yaw = 0.0
        elif move.yaw_rad is None:
            turns = [math.pi * i / FREE_YAWS for i in range(FREE_YAWS)]
            yaw = self._roomiest(move, turns)
        else:
            ahead = tool.yaw_rad + wrap_angle(move.yaw_rad - move.piece.yaw_rad(move.body))
            count = max(1, round(math.pi / move.yaw_period_rad))  # a half turn swaps the fingers
            yaw = self._roomiest(move, [ahead + move.yaw_period_rad * i for i in range(count)])
        return place_command(tool, held, held.moved_to(move.position, yaw - tool.yaw_rad))

    def _roomiest(self, move: Move, yaws_rad: Sequence[float]) -> float:
        """Return the first of the yaws at which the fingers can part most freely."""
        rooms = [min(self.room(move.body, yaw, move.position), AMPLE_M) for yaw in yaws_rad]
        return yaws_rad[rooms.index(max(rooms))]


def _tool_point(at: Vector, candidate: GraspCandidate) -> tuple[float, float]:
    """Return where the tool is to grasp what is at a place."""
    return PlanarFrame(*at[:2], candidate.yaw_rad).to_world(candidate.shift_m, 0.0)
