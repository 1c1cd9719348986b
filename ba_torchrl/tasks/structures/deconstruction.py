"""Deconstruction: the task that takes a structure apart, so that the reversed episode builds it.

An episode starts with the structure standing, and ends when its pieces lie apart on the ground.
The commands that undo its actions, in reverse order, build the structure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ba_torchrl.core.actions import PickPlaceCommand, wrap_angle
from ba_torchrl.sim.bodies import Body, footprint_radius_m, vertical_extent, world_vertices
from ba_torchrl.sim.geometry import (
    ORIGIN,
    Matrix,
    PlanarFrame,
    Pose,
    YawPose,
    downward_pose,
    quaternion_yaw,
    tool_rotation,
)
from ba_torchrl.tasks.base import OpenLoopTask
from ba_torchrl.tasks.manipulation.footprints import extents_m, separation_m
from ba_torchrl.tasks.manipulation.pick_place_commands import no_op, pick_command, place_command
from ba_torchrl.tasks.structures.assignment import mean_position
from ba_torchrl.tasks.structures.blueprint import Slot
from ba_torchrl.tasks.structures.bridges import bridge_yaw_rad
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.pick_place_expert import PickPlaceExpert
from ba_torchrl.tasks.structures.piece_grasps import PickPlaceGrasps
from ba_torchrl.tasks.structures.tilts import release_pose, resting_frame
from ba_torchrl.tasks.workspace import Spacing, random_points

LowestToolHeight = Callable[[tuple[float, float], Matrix], float]
"""Function of x and y of the tool and its rotation, which returns its least height."""
MOVED_M = 5e-3
"""Largest displacement of a body that counts as unmoved."""
APART_BLOCKS = 2.4
"""Least distance between the centres of pieces that lie apart, in blocks."""
GAP_M = 0.02
"""Least gap between the outlines of pieces that lie apart."""
SITE_GAP_M = 5e-3
"""Gap wanted at a site in addition to `GAP_M`."""
RELEASE_CLEARANCE_M = 5e-3
"""Clearance wanted beside the fingers that release a piece at a site."""
SPAN_SHARE = 0.5
"""Upper bound of the random distance between the supports of a bridge, from 0 for that of the
expert to 1 for the largest allowed."""
SITES = 300
"""Largest number of random sites that are compared for a piece."""


class Deconstruction(OpenLoopTask):
    """The reverse of a structure task: the structure stands, and its pieces must be moved apart.

    Args:
        task: the task that builds the structure, with the same bodies and action limits.
    """

    def __init__(self, task: StructureTask) -> None:
        self.task = task
        self._heading_rad: float | None = None
        """Heading with which the structure is aligned on a narrow strip of ground."""
        super().__init__(task.settings, task.world, task.robot, task.terrain)
        self.finger_opening = task.finger_opening

    def load_scene(self) -> None:
        """Load nothing; the structure task has the pieces."""

    def choose_objects(self, rng: np.random.Generator) -> None:
        """Draw the pieces of an episode of the task."""
        self.task.choose_objects(rng)

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place the structure at random, built from the pieces of an episode of the task."""
        self.task.initialize_episode(rng)
        structure = self.task.structure
        slots = structure.blueprint.slots
        unused = list(structure.pieces)
        bodies = []
        for slot in slots:
            candidates = [body for body in unused if structure.pieces[body].kind == slot.piece.kind]
            bodies.append(candidates[rng.integers(len(candidates))])
            unused.remove(bodies[-1])
        # slots on the ground; of two supports of a bridge the first
        on_ground = []
        for i, slot in enumerate(slots):
            _, partner = structure.blueprint.bridge_on(i)
            if not slot.on and (partner is None or partner > i):
                on_ground.append(i)
        width_m = 2 * max(map(footprint_radius_m, bodies)) + self.block_m
        spacings = [Spacing(width_m, width_m)] * len(on_ground)
        points = random_points(self.terrain.build_area, rng, spacings)
        self._heading_rad = self.terrain.build_area.shrunk(width_m / 2).heading_rad
        centers = dict(zip(on_ground, points, strict=True))
        for number, slot in enumerate(slots):
            self._place_in_slot(number, slot, bodies, centers.get(number), rng)

    def is_valid_start(self) -> bool:
        """Whether the structure stands and the scene is valid."""
        return self.task.is_valid() and self.task.is_success() and not self.is_success()

    def evaluate(self) -> dict[str, bool]:
        """Return whether the pieces lie apart on the ground and whether no body is held."""
        return {
            "is_released": self.robot.held_body() is None,
            "is_apart": not self._pieces_to_move(),
        }

    def instruction(self) -> str:
        """Return the instruction to build the structure, which the reversed episode does."""
        return self.task.instruction()

    def is_valid(self) -> bool:
        """Whether the scene is valid for the structure task."""
        return self.task.is_valid()

    @property
    def objects(self) -> Sequence[Body]:
        """The pieces."""
        return self.task.objects

    @property
    def landmarks(self) -> Sequence[YawPose]:
        """The landmarks of the structure task."""
        return self.task.landmarks

    def get_state(self) -> Any:
        """Return the state of the structure task."""
        return self.task.get_state()

    def set_state(self, state: Any) -> None:
        """Restore a state of the structure task."""
        self.task.set_state(state)

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a pick without z.

        The highest piece is grasped at the height above its base at which the reversed episode
        grasps it on the ground. The base of a leaning piece is measured below its centre, above its
        lowest corner.
        """
        base_m = 0.0
        if pieces := self._pieces_to_move():
            top = max(pieces, key=lambda body: body.position[2])
            below_center = top.position[2] + top.shape.bounds_m[0][2]
            base_m = max(vertical_extent(top)[0], below_center) - self.terrain.height_m(xy)
        return self.task.pick_height_m(top_m - base_m, xy) + base_m

    def place_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        return self.task.place_height_m(top_m, xy)

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the window that is searched for the highest point, metres."""
        return self.task.window_m(held)

    def expert_command(self) -> PickPlaceCommand:
        """Pick the highest piece that does not lie apart, and place it on free ground."""
        grasps = self.task.grasps()
        held = self.robot.held_body()
        if held is not None:
            return self._place_apart(held, grasps)
        pieces = self._pieces_to_move()
        if not pieces:
            return no_op(self.settings.workspace, is_holding=False)

        def level(body: Body) -> int:
            x, y, z = body.position
            return round(2 * (z - self.terrain.height_m((x, y))) / self.block_m)

        top = max(map(level, pieces))
        candidates = [body for body in pieces if level(body) == top]
        if self.action_limits.can_tilt:
            return PickPlaceExpert(grasps).pick(min(candidates, key=grasps.pick_cost_m))
        options = [
            (grasps.clearance_m(body, yaw), -i, body, yaw)
            for i, body in enumerate(candidates)
            for yaw in grasps.yaws(body)
        ]
        _, _, body, yaw = max(options, key=lambda option: option[:2])
        x, y, _ = body.position
        z = self.pick_height_m(vertical_extent(body)[1], (x, y))
        return pick_command(downward_pose((x, y, z), yaw))

    # -- start of an episode -----------------------------------------------------------------

    def _place_in_slot(
        self,
        number: int,
        slot: Slot,
        bodies: Sequence[Body],
        center: tuple[float, float] | None,
        rng: np.random.Generator,
    ) -> None:
        """Place a body in its slot, after the bodies of all earlier slots.

        Args:
            center: point of the ground for a slot without supports; for one of two supports of a
                bridge, the point between them.
        """
        structure, body = self.task.structure, bodies[number]
        piece, (bridge, partner) = structure.pieces[body], structure.blueprint.bridge_on(number)
        supports = [bodies[i] for i in slot.on]
        if partner is not None and partner < number:
            xy = bodies[partner].position[:2]
        elif supports:
            xy = mean_position([bodies[i].position for i in slot.centered_over or slot.on])[:2]
        else:
            xy = center
        yaw = self.random_yaw(rng, 2 * math.pi) - piece.grasp_yaws_rad[0]
        if not supports and self._heading_rad is not None:
            yaw = self._heading_rad + math.pi / 2 - piece.grasp_yaws_rad[0]
        if len(supports) == 2:
            yaw = bridge_yaw_rad(supports)
        elif supports and slot.inherits_yaw and self.settings.random_orientation:
            yaw = structure.pieces[supports[0]].yaw_rad(supports[0])
        self.task.stand(body, xy, yaw)
        if supports:
            top = max(vertical_extent(support)[1] for support in supports)
            x, y, z = body.position
            body.place((x, y, z + top - self.terrain.height_m((x, y))), yaw)
        if partner is not None and partner < number:
            self._separate_pair(bridge, supports, [bodies[i] for i in bridge.on], rng)

    def _separate_pair(
        self,
        bridge: Slot,
        supports: Sequence[Body],
        pair: Sequence[Body],
        rng: np.random.Generator,
    ) -> None:
        """Move the two bodies under a bridge from their common centre to a random distance."""
        structure = self.task.structure
        if supports:  # along the y axis of their own support
            yaw = structure.pieces[supports[0]].yaw_rad(supports[0])
        elif self._heading_rad is not None:
            yaw = self._heading_rad - math.pi / 2
        else:
            yaw = self.random_yaw(rng, 2 * math.pi) - bridge.piece.grasp_yaws_rad[0]
        line = np.array([-math.sin(yaw), math.cos(yaw)])
        share = rng.uniform(0.0, SPAN_SHARE)
        distance = (1 - share) * bridge.span.aim_m + share * bridge.span.most_m
        if bridge.span.gap_m is not None:  # sides on which no finger closes face each other
            for body in pair:
                grasp_yaw = structure.pieces[body].grasp_yaws_rad[0]
                body.place(body.position, yaw - grasp_yaw + math.pi * rng.integers(2))
            first, second = (
                (world_vertices(body)[:, :2] - body.position[:2]) @ line for body in pair
            )
            distance += first.max() - second.min()
        for body, side in zip(pair, (-0.5, 0.5), strict=True):
            x, y, z = body.position
            dx, dy = (side * distance * line).tolist()
            body.place((x + dx, y + dy, z), body.yaw_rad)

    # -- expert ------------------------------------------------------------------------------

    def _pieces_to_move(self) -> list[Body]:
        """Return the pieces that are not on the ground, or too close to another."""
        bodies = list(self.objects)
        extents = {body: extents_m(world_vertices(body)[:, :2]) for body in bodies}

        def is_close(body: Body, other: Body) -> bool:
            return (
                math.dist(body.position[:2], other.position[:2]) < APART_BLOCKS * self.block_m
                or separation_m(extents[body], extents[other]) < GAP_M
            )

        return [
            body
            for body in bodies
            if self.terrain.gap_below_m(body) > self.block_m / 4
            or any(is_close(body, other) for other in bodies if other is not body)
        ]

    def _place_apart(self, held: Body, grasps: PickPlaceGrasps) -> PickPlaceCommand:
        """Return the place at the first random site with enough free space, or at the best one."""
        tool, pose = self.robot.tool_frame(), held.pose
        others = [other for other in self.objects if other is not held]
        extents = [extents_m(world_vertices(other)[:, :2]) for other in others]
        outline = world_vertices(held)[:, :2] - held.position[:2]
        border = footprint_radius_m(held) + self.block_m / 4
        area = self.terrain.aside_area.shrunk(border)
        rise_m = grasps.rise_m(held)
        radius_m = footprint_radius_m(held)
        rng = self._generator()
        best, place = -math.inf, None
        for _ in range(SITES):
            x, y = area.random_point(rng)
            origin = self.terrain.origin_pose((x, y), rise_m, radius_m)
            yaw = self._tool_yaw(held, tool.yaw_rad, rng)
            margin = min(
                math.dist((x, y), other.position[:2]) - APART_BLOCKS * self.block_m - GAP_M
                for other in others
            )
            margin -= float(self.terrain.uneven_m(np.array([(x, y)]), radius_m)[0])
            if margin <= best:
                continue
            frame = PlanarFrame(x, y, yaw - tool.yaw_rad)
            own = extents_m(np.stack(frame.to_world(*outline.T), axis=1))
            gap = min(separation_m(own, other) for other in extents)
            clearance = grasps.clearance_m(held, yaw, origin.position)
            margin = min(margin, gap - GAP_M - SITE_GAP_M, clearance - RELEASE_CLEARANCE_M)
            if margin > best:
                best = margin
                target = pose.moved_to(origin.position, yaw - tool.yaw_rad)
                if self.action_limits.can_tilt:
                    piece = self.task.structure.pieces[held]
                    frame_yaw = quaternion_yaw(resting_frame(piece, held)) + yaw - tool.yaw_rad
                    target = release_pose(piece, held, origin, frame_yaw)
                place = place_command(tool, pose, target)
            if margin >= 0:
                break
        assert place is not None  # the first site improves on minus infinity
        return place

    def _tool_yaw(self, held: Body, tool_yaw_rad: float, rng: np.random.Generator) -> float:
        """Return the yaw of the gripper for a place: random, or the fixed orientation's."""
        if not self.action_limits.turn_rad:
            return 0.0
        if self.settings.random_orientation:
            return float(rng.uniform(0.0, math.pi))
        piece = self.task.structure.pieces[held]
        turn = -piece.grasp_yaws_rad[0] - piece.yaw_rad(held)
        return tool_yaw_rad + wrap_angle(turn, piece.yaw_period_rad)

    def _generator(self) -> np.random.Generator:
        """Return a random generator seeded with the positions of the pieces."""
        poses = np.array([body.position for body in self.objects])
        return np.random.default_rng(np.frombuffer(poses.tobytes(), np.uint32).tolist())


class UndoRecorder(NamedTuple):
    """The scene before an action, from which the command that undoes the action follows."""

    poses: Mapping[Body, Pose]
    held: Body | None
    grasp: Pose | None
    """Pose of the held body in the frame of the tool."""

    def undo_command(
        self,
        held: Body | None,
        grasp: Pose | None,
        lowest_tool_m: LowestToolHeight = lambda xy, rotation: -math.inf,
    ) -> PickPlaceCommand | None:
        """Return the command that undoes the action since the recording.

        A pick is undone by a place at the pose from which the body was picked, a place by a pick at
        the pose where the body came to rest. Both use the grasp of the body, so the tool pose
        differs from the action's if the body slipped or settled.

        Args:
            held: the body in the gripper now.
            grasp: pose of the held body in the frame of the tool now.
            lowest_tool_m: returns for x and y and the rotation of the tool its least height for a
                pick, metres.

        Returns:
            None if the action neither picked nor placed a body, or moved another body.
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
        lowest_m = lowest_tool_m((command.x_m, command.y_m), tool_rotation(*command.angles_rad))
        return command._replace(z_m=max(command.z_m, lowest_m))
