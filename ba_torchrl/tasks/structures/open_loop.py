"""What the open-loop tasks share that build something from pieces."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from ba_torchrl.actions import PickPlaceCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, footprint_radius_m
from ba_torchrl.sim.geometry import PlanarFrame, Vector, downward_pose
from ba_torchrl.tasks.base import Task
from ba_torchrl.tasks.clearance import grasp_clearance_m, hand_clearance_m, path_clearance_m
from ba_torchrl.tasks.open_loop_task import OpenLoopControl
from ba_torchrl.tasks.pick_place_commands import no_op, pick_command, place_command
from ba_torchrl.tasks.structures.blocking import GraspCandidate, GraspQueries, edge_grasps
from ba_torchrl.tasks.structures.blueprint import Blueprint
from ba_torchrl.tasks.structures.deconstruction import Deconstruction
from ba_torchrl.tasks.structures.free_space import PlacementArea
from ba_torchrl.tasks.structures.planner import CROWDED, Move, StructurePlanner
from ba_torchrl.tasks.structures.structure import Structure

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


class StructureTask(OpenLoopControl, GraspQueries, Task):
    """Pieces scattered on the ground; success when they stand as the blueprint says."""

    can_be_deconstructed = True
    tipping_ends: ClassVar[bool] = True
    """Whether a piece on its side, such as a roof, ends the episode."""
    clears_blocked_pieces: ClassVar[bool] = False
    """Whether the expert removes pieces that block the grasp of another. Off for structures with
    long pieces, where the removals would not end."""
    start_gap_m: ClassVar[float] = 0.01
    """Least distance between the circles around two pieces at the start."""
    least_pick_blocks: ClassVar[float] = 0.5
    """Least height of a pick above the ground in blocks, where an action leaves it open: between
    two pixels a ridge looks lower than it is, and closing fingers reach lower."""

    @abstractmethod
    def blueprint(self) -> Blueprint:
        """Return the structure."""

    def load_scene(self) -> None:
        """Load the pieces."""
        self.structure = Structure(
            self.blueprint(), self.world, self.block_m, self.terrain.support_ids
        )

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Put the pieces anywhere, apart from each other.

        Fixed orientations are those at which a gripper that does not turn can grasp them.
        """
        self.structure.draw(rng)
        points = self.random_points(rng, self.structure.spots(self.start_gap_m))
        for (body, piece), xy in zip(self.structure.pieces.items(), points, strict=True):
            yaw = self.random_yaw(rng, 2 * math.pi) - piece.grasp_yaws_rad[0]
            self.stand(body, xy, yaw)

    @property
    def planner(self) -> StructurePlanner:
        """Compares the pieces with the blueprint."""
        return self.structure.planner

    @property
    def objects(self) -> Sequence[Body]:
        """The pieces."""
        return list(self.structure.pieces)

    def get_state(self) -> Any:
        """Return which variants of the pieces are in the scene."""
        return self.structure.get_state()

    def set_state(self, state: Any) -> None:
        """Restore a state of `get_state`."""
        self.structure.set_state(state)

    def deconstruction(self) -> Deconstruction:
        """Return the task that takes the structure apart."""
        return Deconstruction(self)

    def evaluate(self) -> dict[str, bool]:
        """Return whether the structure stands, with none of its pieces in the gripper."""
        return self.planner.evaluate(self.robot.held_body())

    def is_valid(self) -> bool:
        """Whether all is inside the workspace, and nothing on its side that must not be."""
        if not super().is_valid():
            return False
        return not (self.tipping_ends and self.planner.has_tipped(self.robot.held_body()))

    def expert_command(self) -> PickPlaceCommand:
        """Move the piece that comes next, from any state."""
        held = self.robot.held_body()
        move = self.planner.next_move(self._placement_area(), held, self)
        if move is None:
            return no_op(self.settings.workspace, held is not None)
        if move.body is held:
            return self._place(move)
        candidate = self._best_grasp(move.body)
        yaw, z = candidate.yaw_rad, move.body.position[2]
        x, y = _tool_point(move.body.position, candidate)
        z = max(z, self.lowest_tool_m((x, y)))
        return pick_command(downward_pose((x, y, z), yaw))

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a pick, at least `least_pick_blocks`."""
        least_m = self.terrain.height_m(xy) + self.least_pick_blocks * self.block_m
        return max(super().pick_height_m(top_m, xy), least_m)

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the square searched for the highest point.

        A long piece may rest on others that are far from its middle; one that always goes to the
        ground must not be placed on what stands beside it.
        """
        if held is None or not self._rests_on_others(held):
            return super().window_m(held)
        low, high = held.shape.bounds_m
        longest = max(high[0] - low[0], high[1] - low[1])
        return max(super().window_m(held), 0.375 * longest)

    def _rests_on_others(self, body: Body) -> bool:
        kind = self.planner.pieces[body].kind
        return any(slot.on and slot.piece.kind == kind for slot in self.planner.blueprint.slots)

    # ----------------------------------------------------------------------------------------

    def _placement_area(self) -> PlacementArea:
        return PlacementArea(
            *self.terrain.build_area.shrunk(1.5 * self.block_m),
            gap_m=2.0 * self.block_m,
            height_m=self.terrain.height_m,
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
        others = [other for other in self.objects if other is not body]
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
        return self.terrain.gap_below_m(body) < self.block_m / 4

    def _ease(self, body: Body, candidate: GraspCandidate) -> tuple[float, bool, float]:
        """Return how easy a way to grasp a body is.

        Returns:
            Metres that are wanting for it, negative; whether it is plain, which is best where
            nothing is; and the room, a finger that wedges itself in counted as well.
        """
        others = [other for other in self.objects if other is not body]
        room = spare = self._room_beside(body, candidate, others, None)
        if candidate.shift_m:
            gripper, yaw = self.robot.gripper, candidate.yaw_rad
            near = (candidate.near_finger_range_m,)
            spare = min(room, path_clearance_m(gripper, body, yaw, near, others))
        return min(room, 0.0), not candidate.shift_m, spare

    def _room_beside(
        self, body: Body, candidate: GraspCandidate, others: Sequence[Body], at: Vector | None
    ) -> float:
        """Return the gap between the hand, open around a body, and some others."""
        at = body.position if at is None else at
        (x, y), z = _tool_point(at, candidate), at[2]
        extent = math.hypot(*self.robot.hand_half_extents_m) + AMPLE_M
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

    def site_deficit_m(self, sites: np.ndarray, rest: Sequence[Body]) -> np.ndarray:
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
            halves.append([self.robot.hand_half_extents_m, self.robot.hand_half_extents_m, load])
        x, y = np.moveaxis(sites[:, :, None] - centers, 3, 0)[..., None]  # [S, P, rest, 1]
        cos, sin = np.cos(yaws), np.sin(yaws)
        half_along, half_across = np.moveaxis(np.array(halves), 2, 0)
        along, across = np.abs(x * cos + y * sin), np.abs(y * cos - x * sin)
        gaps = np.maximum(along - half_along, across - half_across).min(axis=1)  # [S, rest, 3]
        gaps = np.minimum(gaps[:, :, :2].max(axis=2), gaps[:, :, 2])
        return np.maximum(SITE_GAP_M + self.block_m / 2 - gaps, 0.0).sum(axis=1)

    def blocks_grasp(self, body: Body, other: Body, place: Vector | None) -> list[bool]:
        """Return whether another piece is in the hand's way, for each way to grasp a body."""
        at = body.position
        if place is not None:  # as seen from there
            moved = zip(at, other.position, place, strict=True)
            at = tuple(a + b - c for a, b, c in moved)
        return [
            self._room_beside(body, candidate, [other], at) <= 0
            for candidate in self._grasp_candidates(body)
        ]

    def pick_effort_m(self, body: Body) -> float:
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
        tool, held = self.robot.tool_frame(), move.body.pose
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
