"""Deconstruction: structures taken apart, step by step, so that the reverse builds them.

An episode starts with the structure standing, and ends when its pieces lie apart on the ground.
Every action leaves something that undoes it; in reverse order these actions build the structure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from ba_torchrl.actions import PickPlaceCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, footprint_radius_m, vertical_extent, world_vertices
from ba_torchrl.sim.geometry import (
    ORIGIN,
    PlanarFrame,
    Pose,
    Vector,
    YawPose,
    downward_pose,
)
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.base import TaskSettings
from ba_torchrl.tasks.open_loop_task import OpenLoopTask
from ba_torchrl.tasks.pick_place_commands import no_op, pick_command, place_command
from ba_torchrl.tasks.structures.blueprint import Slot
from ba_torchrl.tasks.structures.planner import StructurePlanner
from ba_torchrl.tasks.terrain import Terrain
from ba_torchrl.tasks.workspace import Spot

APART_BLOCKS = 2.4
"""Pieces that lie apart keep this distance of their centres, as at the start of an episode."""
GAP_M = 0.02
"""They also leave this much between their outlines."""
AMPLE_GAP_M = 5e-3
AMPLE_ROOM_M = 5e-3
"""A site for a piece leaves this much more to its neighbours, and to the fingers."""
SPAN_SHARE = 0.5
"""Pairs stand up to this share of the way from the span aimed for to the greatest allowed."""
SITES = 300
"""Random sites that are tried for a piece; the best of them is good enough."""
BEARINGS = 16
"""Directions along which the gap between two outlines is measured."""
MOVED_M = 5e-3
"""What moves less than this stays where it is."""

_DIRECTIONS = np.array(
    [[math.cos(a), math.sin(a)] for a in np.arange(BEARINGS) * math.pi / BEARINGS]
).T


class Deconstructible(Protocol):
    """What deconstruction needs of the task that builds a structure, besides `OpenLoopTask`."""

    settings: TaskSettings
    world: World
    robot: Robot
    terrain: Terrain
    finger_opening: float
    planner: StructurePlanner

    def room(self, body: Body, yaw_rad: float, at: Vector | None = None) -> float:
        """Return the gap between the hand, open around a body, and what stands beside it."""

    def grasp_yaws(self, body: Body) -> list[float]:
        """Return the yaws at which the gripper grasps a body."""


class Deconstruction(OpenLoopTask):
    """A structure's task backwards: the goal stands at the start, and must be taken apart.

    Args:
        task: what builds the structure; its bodies, limits and heights hold here too.
    """

    def __init__(self, task: Deconstructible) -> None:
        self.task = task
        super().__init__(task.settings, task.world, task.robot, task.terrain)
        self.finger_opening = task.finger_opening

    def load_scene(self) -> None:
        """The pieces are those of the task."""

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Stand the structure somewhere, its pieces drawn as for building it."""
        self.task.initialize_episode(rng)
        planner = self.task.planner
        slots = planner.blueprint.slots
        pool = list(planner.pieces)
        bodies = []
        for slot in slots:
            mates = [body for body in pool if planner.pieces[body].kind == slot.piece.kind]
            bodies.append(mates[rng.integers(len(mates))])
            pool.remove(bodies[-1])
        grounded = [
            i
            for i, slot in enumerate(slots)
            if not slot.on
            and (planner.blueprint.partner(i) is None or planner.blueprint.partner(i) > i)
        ]
        room = 2 * max(map(footprint_radius_m, bodies)) + self.block_m
        centers = dict(
            zip(grounded, self.random_points(rng, [Spot(room, room)] * len(grounded)), strict=True)
        )
        for number, slot in enumerate(slots):
            self._stand_in(number, slot, bodies, centers.get(number), rng)

    def is_valid_start(self) -> bool:
        """Whether the structure stands."""
        return self.task.is_valid() and self.task.is_success() and not self.is_success()

    def evaluate(self) -> dict[str, bool]:
        """Return whether the pieces lie on the ground, apart from each other, none of them held."""
        return {
            "is_released": self.robot.held_body() is None,
            "is_apart": not self._to_move(),
        }

    def is_valid(self) -> bool:
        """Whether the scene is one of the task's."""
        return self.task.is_valid()

    @property
    def objects(self) -> Sequence[Body]:
        """The pieces."""
        return self.task.objects

    @property
    def landmarks(self) -> Sequence[YawPose]:
        """What the task's vector observation lists."""
        return self.task.landmarks

    def get_state(self) -> Any:
        """Return what the task remembers."""
        return self.task.get_state()

    def set_state(self, state: Any) -> None:
        """Take up what `get_state` returned."""
        self.task.set_state(state)

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a pick, where an action leaves it open.

        The next piece is held as it will be when it is picked from the ground. Its base is that of
        its middle: leaning, its lowest corner lies deeper, and it would be held too low.
        """
        base_m = 0.0
        if to_move := self._to_move():
            top = max(to_move, key=lambda body: body.position[2])
            middle = top.position[2] + top.shape.bounds_m[0][2]
            base_m = max(vertical_extent(top)[0], middle) - self.terrain.height_m(xy)
        return self.task.pick_height_m(top_m - base_m, xy) + base_m

    def place_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a place, where an action leaves it open."""
        return self.task.place_height_m(top_m, xy)

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the square searched for the highest point."""
        return self.task.window_m(held)

    def expert_command(self) -> PickPlaceCommand:
        """Take the highest piece, put it on free ground; a function of the scene."""
        held = self.robot.held_body()
        if held is not None:
            return self._put_away(held)
        to_move = self._to_move()
        if not to_move:
            return no_op(self.settings.workspace, is_holding=False)

        def level(body: Body) -> int:
            x, y, z = body.position
            return round(2 * (z - self.terrain.height_m((x, y))) / self.block_m)

        top = max(map(level, to_move))
        options = [
            (self.task.room(body, yaw), -i, body, yaw)
            for i, body in enumerate(to_move)
            if level(body) == top
            for yaw in self.task.grasp_yaws(body)
        ]
        _, _, body, yaw = max(options, key=lambda option: option[:2])
        x, y, _ = body.position
        z = self.pick_height_m(vertical_extent(body)[1], (x, y))
        return pick_command(downward_pose((x, y, z), yaw))

    # -- the structure -----------------------------------------------------------------------

    def _stand_in(
        self,
        number: int,
        slot: Slot,
        bodies: Sequence[Body],
        center: tuple[float, float] | None,
        rng: np.random.Generator,
    ) -> None:
        """Put a body into its slot; those in the slots before are in theirs.

        Args:
            number: of the slot.
            slot: the slot.
            bodies: the body in each slot.
            center: where on the ground it goes, or the middle of its pair.
            rng: generator.
        """
        planner, body = self.task.planner, bodies[number]
        piece, partner = planner.pieces[body], planner.blueprint.partner(number)
        supports = [bodies[i] for i in slot.on]
        if partner is not None and partner < number:
            xy = bodies[partner].position[:2]
        elif supports:
            xy = _middle([bodies[i].position[:2] for i in slot.over or slot.on])
        else:
            xy = center
        yaw = self.random_yaw(rng, 2 * math.pi) - piece.grasp_yaws_rad[0]
        if len(supports) == 2:
            (ax, ay, _), (bx, by, _) = (support.position for support in supports)
            yaw = math.atan2(by - ay, bx - ax) - math.pi / 2
        elif supports and slot.inherits_yaw and self.settings.random_orientation:
            yaw = planner.pieces[supports[0]].yaw_rad(supports[0])
        self.task.stand(body, xy, yaw)
        if supports:
            lift = max(vertical_extent(support)[1] for support in supports)
            x, y, z = body.position
            body.place((x, y, z + lift - self.terrain.height_m((x, y))), yaw)
        if partner is not None and partner < number:
            self._part(number, bodies, rng)

    def _part(self, number: int, bodies: Sequence[Body], rng: np.random.Generator) -> None:
        """Part two bodies that stand in one place, as a bridge needs it."""
        planner = self.task.planner
        slots = planner.blueprint.slots
        bridge = slots[planner.blueprint.bridge_on(number)]
        pair = [bodies[i] for i in bridge.on]
        if slots[number].on:  # along the piece that carries them, which is long along y
            support = bodies[slots[number].on[0]]
            heading = planner.pieces[support].yaw_rad(support)
        else:
            heading = self.random_yaw(rng, 2 * math.pi) - bridge.piece.grasp_yaws_rad[0]
        line = np.array([-math.sin(heading), math.cos(heading)])
        share = rng.uniform(0.0, SPAN_SHARE)
        apart = (1 - share) * bridge.span.aim_m + share * bridge.span.most_m
        if bridge.span.gap_m is not None:  # as near as that only with the free sides to each other
            for body in pair:
                grasp_yaw = planner.pieces[body].grasp_yaws_rad[0]
                body.place(body.position, heading - grasp_yaw + math.pi * rng.integers(2))
            first, second = (
                (world_vertices(body)[:, :2] - body.position[:2]) @ line for body in pair
            )
            apart += first.max() - second.min()
        for body, side in zip(pair, (-0.5, 0.5), strict=True):
            x, y, z = body.position
            dx, dy = (side * apart * line).tolist()
            body.place((x + dx, y + dy, z), body.yaw_rad)

    # -- taking it apart ---------------------------------------------------------------------

    def _to_move(self) -> list[Body]:
        """Return the pieces that are not on the ground, or too near another."""
        bodies = list(self.objects)
        shadows = {body: _shadow(world_vertices(body)[:, :2]) for body in bodies}

        def is_near(body: Body, other: Body) -> bool:
            return (
                math.dist(body.position[:2], other.position[:2]) < APART_BLOCKS * self.block_m
                or _gap_m(shadows[body], shadows[other]) < GAP_M
            )

        return [
            body
            for body in bodies
            if self.terrain.gap_below_m(body) > self.block_m / 4
            or any(is_near(body, other) for other in bodies if other is not body)
        ]

    def _put_away(self, held: Body) -> PickPlaceCommand:
        """Return the place on the first of many random sites that has room enough."""
        tool, pose = self.robot.tool_frame(), held.pose
        others = [other for other in self.objects if other is not held]
        shadows = [_shadow(world_vertices(other)[:, :2]) for other in others]
        outline = world_vertices(held)[:, :2] - held.position[:2]
        border = footprint_radius_m(held) + self.block_m / 4
        ranges = self.terrain.build_area.shrunk(border)
        rise_m = held.position[2] - vertical_extent(held)[0]
        rng = self._generator()
        best, place = -math.inf, None
        for _ in range(SITES):
            x, y = (float(rng.uniform(low, high)) for low, high in ranges)
            z = self.terrain.height_m((x, y)) + rise_m
            yaw = self._tool_yaw(held, tool.yaw_rad, rng)
            slack = min(
                math.dist((x, y), other.position[:2]) - APART_BLOCKS * self.block_m - GAP_M
                for other in others
            )
            if slack <= best:
                continue
            frame = PlanarFrame(x, y, yaw - tool.yaw_rad)
            turned = np.stack(frame.to_world(*outline.T), axis=1)
            gap = min(_gap_m(_shadow(turned), shadow) for shadow in shadows)
            room = self.task.room(held, yaw, (x, y, z))
            slack = min(slack, gap - GAP_M - AMPLE_GAP_M, room - AMPLE_ROOM_M)
            if slack > best:
                best = slack
                target = pose.moved_to((x, y, z), yaw - tool.yaw_rad)
                place = place_command(tool, pose, target)
            if slack >= 0:
                break
        assert place is not None  # the first site is better than nothing
        return place

    def _tool_yaw(self, held: Body, tool_yaw_rad: float, rng: np.random.Generator) -> float:
        """Return the gripper's yaw for a place: any, or the one that gives a fixed orientation."""
        if not self.action_limits.turn_rad:
            return 0.0
        if self.settings.random_orientation:
            return float(rng.uniform(0.0, math.pi))
        piece = self.task.planner.pieces[held]
        ahead = -piece.grasp_yaws_rad[0] - piece.yaw_rad(held)
        return tool_yaw_rad + wrap_angle(ahead, piece.yaw_period_rad)

    def _generator(self) -> np.random.Generator:
        """Return a generator keyed on the scene."""
        poses = np.array([body.position for body in self.objects])
        return np.random.default_rng(np.frombuffer(poses.tobytes(), np.uint32).tolist())


def _middle(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
    return tuple(sum(values) / len(values) for values in zip(*points, strict=True))


def _shadow(points: np.ndarray) -> np.ndarray:
    """Return the extent of points [V, 2] along every bearing, [2, BEARINGS]."""
    along = points @ _DIRECTIONS
    return np.stack([along.min(axis=0), along.max(axis=0)])


def _gap_m(one: np.ndarray, other: np.ndarray) -> float:
    """Return a distance that two convex outlines surely keep, from their shadows."""
    return float(np.maximum(one[0] - other[1], other[0] - one[1]).max())


class Watch(NamedTuple):
    """How things lay before an action, to tell afterwards what undoes it."""

    poses: Mapping[Body, Pose]
    held: Body | None
    grasp: Pose | None
    """Pose of what was held in the frame of the tool."""

    def undo(
        self,
        held: Body | None,
        grasp: Pose | None,
        lowest_m: Callable[[tuple[float, float]], float] = lambda xy: -math.inf,
    ) -> PickPlaceCommand | None:
        """Return what undoes the action that has just settled.

        The tool goes where it has the body, grasped as it was, in the pose from which it was
        picked or in which it came to lie; that differs from where the action itself went if the
        body slipped or settled.

        Args:
            held: what is held now.
            grasp: and how.
            lowest_m: from x and y to the least height of the tool at which the fingers close.

        Returns:
            None if nothing undoes it: it grasped or put down nothing, or another body moved.
        """
        if (self.held is None) == (held is None):
            return None
        body = held if self.held is None else self.held
        for other, (before, _) in self.poses.items():
            if other is not body and math.dist(before, other.position) > MOVED_M:
                return None
        if self.held is None:
            return place_command(Pose(ORIGIN), grasp, self.poses[body])
        command = pick_command(body.pose.compose(self.grasp.inverse()))
        return command._replace(z_m=max(command.z_m, lowest_m((command.x_m, command.y_m))))


def watch(bodies: Sequence[Body], held: Body | None, grasp: Pose | None) -> Watch:
    """Return how bodies lie now, and what is held how."""
    return Watch({body: body.pose for body in bodies}, held, grasp)
