"""Drawer Opening: pull a drawer open by its handle (appendix A.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum, auto
from typing import ClassVar

import numpy as np

from ba_torchrl.core.actions import GripperCommand, wrap_angle
from ba_torchrl.core.errors import PlacementError
from ba_torchrl.sim.articulated import PrismaticJoint
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import PlanarFrame, Vector, YawPose
from ba_torchrl.sim.meshes import Mesh, box_mesh, rod_mesh, transform_mesh
from ba_torchrl.sim.shapes import Color, Solid
from ba_torchrl.tasks.base import TASKS, CloseLoopTask
from ba_torchrl.tasks.instructions import colored
from ba_torchrl.tasks.manipulation.clearance import (
    SIDE_MARGIN_M,
    passing_height_m,
    tips_below_tool_m,
)
from ba_torchrl.tasks.manipulation.primitives import (
    ALIGNED_M,
    ALIGNED_RAD,
    CLOSED,
    IS_CLOSED,
    move_toward,
    nearest_equivalent_yaw,
)
from ba_torchrl.tasks.manipulation.progress_terms import nearness, share, staged, turn_m
from ba_torchrl.tasks.workspace import LAYOUT_ATTEMPTS

CABINET_M: Vector = (0.22, 0.23, 0.11)
"""Depth along x, width and height; the open front faces +x."""
WALL_M = 0.01
"""Thickness of the walls of the cabinet and of the front of the drawer."""
DRAWER_WALL_M = 0.006
"""Thickness of the other walls of the drawer."""
PLAY_M = 0.003
"""Gap between drawer and cabinet on each side."""
RIM_M = 0.085
"""Height of the upper edge of the drawer's sides above the floor."""
ROD_LENGTH_M, ROD_DIAMETER_M = 0.1, 0.015
"""The handle is a rod on two posts."""
ROD_OFFSET_M, ROD_HEIGHT_M = 0.05, 0.08
"""Distance of the rod's axis from the front, and its height above the floor."""
POST_M = 0.008
"""Width and height of the posts."""
POST_GAP_M = 0.07
"""Gap between the posts, in which the closed fingers are up to 6 cm wide."""

WOOD: Color = (0.72, 0.55, 0.38, 1.0)
LIGHT_WOOD: Color = (0.9, 0.78, 0.6, 1.0)

HOOK_DEPTH_M = 0.01
"""Depth of the tool below the rod's axis during the pull; the fingertips are 1.5 cm lower."""
LEAST_HOOK_M = 0.005
"""Least depth of the fingertips below the rod's axis during the pull, which continues to lower
them."""
DESCENT_GAP_M = 0.012
"""Gap between rod and fingers that descend behind it; less for fingers that nearly fill the space
between rod and front."""
HOOK_YAW_RAD = 0.4
"""Largest yaw error of fingers that pull. Beyond it the gripper is wider in front of the
cabinet."""
HEIGHT_TOLERANCE_M = 0.01
"""Part of the height above cabinet and rod that may be missing while the tool moves there."""
BEHIND_ROD_M = 0.0095
"""Distance behind the rod up to which the workspace must contain the path of the tool."""
OVERSHOOT_M = 0.01
"""Distance by which the expert opens the drawer beyond the goal."""


@TASKS.register("close_loop/drawer_opening")
class DrawerOpening(CloseLoopTask):
    """Objects: a cabinet of 22 x 23 x 11 cm with one drawer, at a random pose beside the workspace.

    Goal: the drawer is open by more than 15 cm. Nothing ends the episode early.
    Paper, appendix A.2.
    """

    scale_limits = (0.85, 1.4)
    goal_travel_m: ClassVar[float] = 0.15
    """Least travel of the drawer at success, at scale 1, metres."""
    travel_range_m: ClassVar[tuple[float, float]] = (0.0, 0.2)
    """Range of the travel at scale 1, metres."""
    friction_n: ClassVar[float] = 3.0
    """Friction of the rail, newtons. The drawer of 0.5 kg decelerates faster than the fingers, so
    it stays in contact with them."""

    def load_scene(self) -> None:
        """Load the cabinet with its drawer."""
        scale = self.settings.scale
        low, high = self.travel_range_m
        self.cabinet = self.world.add_articulated(
            Solid(parts=_scaled(cabinet_parts(), scale), mass_kg=0.0, color=WOOD),
            Solid(
                parts=_scaled(drawer_parts(), scale),
                mass_kg=0.5,
                color=LIGHT_WOOD,
            ),
            PrismaticJoint(limits_m=(low * scale, high * scale), friction_n=self.friction_n),
            "cabinet",
        )

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place the cabinet beside the workspace, with its front towards the centre.

        One layout in five is rejected, as its handle leaves the workspace before the goal.
        """
        scale = self.settings.scale
        x, y = self.settings.workspace.center
        for _ in range(LAYOUT_ATTEMPTS):
            if self.settings.random_orientation:
                yaw = float(rng.uniform(0.0, 2 * math.pi))
            else:
                yaw = float(rng.choice((math.pi / 2, 3 * math.pi / 2)))
            back, aside = scale * float(rng.uniform(0.15, 0.2)), float(rng.uniform(-0.1, 0.1))
            xy = PlanarFrame(x, y, yaw).to_world(-back, aside)
            self.cabinet.place((*xy, self.terrain.height_m(xy)), yaw)
            if self._can_be_opened():
                return
        raise PlacementError(
            "no place for the cabinet lets its handle move inside the workspace: enlarge "
            "`workspace` or lower `object_scale_range`"
        )

    def evaluate(self) -> dict[str, bool]:
        """Return whether the drawer is open by more than 15 cm."""
        return {"is_open": self.cabinet.travel_m > self.goal_m}

    def instruction(self) -> str:
        """Return the instruction with the cabinet's colour."""
        return f"open the drawer of the {colored(self.cabinet.base, 'cabinet')}"

    def progress(self) -> float:
        """Return the progress in two stages: reach behind the handle, and travel of the drawer."""
        robot, scale = self.robot, self.settings.scale
        (x, y, z), _ = robot.tool_pose()
        (rx, ry, rz), heading = self.handle_pose
        ahead, across = PlanarFrame(rx, ry, heading).to_local(x, y)
        finger, radius = robot.gripper.half_width_m, ROD_DIAMETER_M / 2 * scale
        near, far = -radius - finger, finger - ROD_OFFSET_M * scale  # fingers touch rod or front
        offset = (
            max(far - ahead, ahead - near, 0.0),
            max(abs(across) - POST_GAP_M / 2 * scale + finger, 0.0),
            max(z - tips_below_tool_m(robot) - rz + LEAST_HOOK_M, 0.0),
        )
        return staged(
            nearness(math.hypot(*offset) + turn_m(robot, [heading + math.pi / 2])),
            share(self.cabinet.travel_m, 0.0, self.goal_m),
        )

    def expert_command(self) -> GripperCommand:
        """Descend behind the handle with closed fingers and pull it."""
        return _Pull(self).command()

    @property
    def handle_pose(self) -> YawPose:
        """Centre of the handle's rod, and yaw of the direction in which the drawer opens."""
        slider, scale = self.cabinet.slider, self.settings.scale
        (x, y, z), heading = slider.position, slider.yaw_rad
        out = (CABINET_M[0] / 2 + ROD_OFFSET_M) * scale
        center = PlanarFrame(x, y, heading).to_world(out, 0.0)
        return (*center, z + ROD_HEIGHT_M * scale), heading

    @property
    def landmarks(self) -> Sequence[YawPose]:
        """Poses of cabinet and handle."""
        base = self.cabinet.base
        return [(base.position, base.yaw_rad), self.handle_pose]

    @property
    def objects(self) -> Sequence[Body]:
        """None; the drawer cannot leave its rail."""
        return ()

    @property
    def goal_m(self) -> float:
        """Least travel of the drawer at success, metres."""
        return self.goal_travel_m * self.settings.scale

    def _can_be_opened(self) -> bool:
        """Whether the workspace contains the path of the tool up to the goal."""
        (x, y, z), heading = self.handle_pose
        ux, uy = math.cos(heading), math.sin(heading)
        behind = -ROD_DIAMETER_M - BEHIND_ROD_M
        return all(
            self.settings.workspace.contains((x + s * ux, y + s * uy, z - HOOK_DEPTH_M))
            for s in (behind, self.goal_m)
        )


class PullPhase(Enum):
    """What the gripper does next; the first phase whose condition holds."""

    TURN = auto()
    """Behind the rod, between the posts, the fingers turn in place."""
    PULL = auto()
    """They are there, and their tips below the axis of the rod: they pull."""
    DESCEND = auto()
    """They descend there, or from where they have a free way, and turn meanwhile."""
    RISE = auto()
    """Elsewhere they rise over cabinet and rod."""
    APPROACH = auto()
    """They move and turn over cabinet and rod."""


class _Pull:
    """The expert's pull in the present scene.

    Coordinates of the tool are along the direction of the pull and across it, from the rod's axis.
    """

    def __init__(self, task: DrawerOpening) -> None:
        self.task = task
        self.robot = robot = task.robot
        self.scale = scale = task.settings.scale
        self.position, yaw = robot.tool_pose()
        (rx, ry, self.rod_z_m), self.heading_rad = task.handle_pose
        self.handle = PlanarFrame(rx, ry, self.heading_rad)
        self.ahead_m, self.across_m = self.handle.to_local(*self.position[:2])
        self.yaw_rad = nearest_equivalent_yaw(
            yaw, self.heading_rad + math.pi / 2, task.action_limits, math.pi
        )
        self.turn_rad = abs(wrap_angle(self.yaw_rad - yaw))
        self.radius_m = ROD_DIAMETER_M / 2 * scale
        self.front_m = -ROD_OFFSET_M * scale
        self.side_m = POST_GAP_M / 2 * scale
        self.hook_z_m = self.rod_z_m - HOOK_DEPTH_M * scale
        self.finger_m = robot.gripper.half_width_m
        self.tips_z_m = self.position[2] - tips_below_tool_m(robot)
        gap_m = min(DESCENT_GAP_M, (-self.radius_m - self.front_m) / 2 - self.finger_m)
        self.behind_m = -self.radius_m - self.finger_m - gap_m
        self.behind = self.handle.to_world(self.behind_m, 0.0)

    def command(self) -> GripperCommand:
        """Return the next command."""
        z = self.position[2]
        match self.phase():
            case PullPhase.TURN:
                return move_toward(self.robot, (*self.behind, z), self.yaw_rad, CLOSED)
            case PullPhase.PULL:
                return self._pull()
            case PullPhase.DESCEND:
                target = (*self.behind, self.hook_z_m)
                return move_toward(self.robot, target, self.yaw_rad, CLOSED)
            case PullPhase.RISE:
                # the rod may be between the fingers
                opening = CLOSED if self.turn_rad < math.pi / 4 else self.robot.opening()
                target = (*self.position[:2], self._over_z_m())
                return move_toward(self.robot, target, self.yaw_rad, opening)
            case PullPhase.APPROACH:
                target = (*self.behind, min(z, self._over_z_m()))
                return move_toward(self.robot, target, self.yaw_rad, CLOSED)

    def phase(self) -> PullPhase:
        """Return the phase of the present scene."""
        if self.robot.opening() < IS_CLOSED:
            is_in_slot = (
                self.tips_z_m < self.rod_z_m + self.radius_m
                and self.front_m < self.ahead_m < -self.radius_m
                and abs(self.across_m) < self.side_m - self.finger_m
            )
            if is_in_slot and self.turn_rad >= HOOK_YAW_RAD:
                return PullPhase.TURN
            if is_in_slot and self.tips_z_m < self.rod_z_m - LEAST_HOOK_M:
                return PullPhase.PULL
            if is_in_slot or self._can_descend():
                return PullPhase.DESCEND
        is_low = self.position[2] < self._over_z_m() - HEIGHT_TOLERANCE_M
        return PullPhase.RISE if is_low else PullPhase.APPROACH

    def _pull(self) -> GripperCommand:
        to_rod_m = -self.ahead_m - self.radius_m - self.finger_m
        remaining_m = self.task.goal_m + OVERSHOOT_M - self.task.cabinet.travel_m + to_rod_m
        heading = self.heading_rad
        step_m = self.task.action_limits.step_m
        longest_m = step_m / max(abs(math.cos(heading)), abs(math.sin(heading)))
        target = self.handle.to_world(self.ahead_m + min(remaining_m, longest_m), 0.0)
        return move_toward(self.robot, (*target, self.hook_z_m), self.yaw_rad, CLOSED)

    def _over_z_m(self) -> float:
        """Return the height of a tool that passes over what is below it: cabinet, or rod."""
        reach_m = self.finger_m * math.cos(self.turn_rad)
        reach_m += self._half_span_m() * math.sin(self.turn_rad)
        is_over_cabinet = self.ahead_m - reach_m < self.front_m
        top_m = CABINET_M[2] * self.scale if is_over_cabinet else self.rod_z_m + self.radius_m
        return top_m + passing_height_m(self.robot.gripper)

    def _can_descend(self) -> bool:
        """Whether closed fingers can descend behind the rod, and turn meanwhile.

        They can if they are aligned, or clear of cabinet, rod, front and posts when their tips
        pass the tops of these on the straight way. A learner's errors in yaw and position then
        lead to the slot behind the rod, and not to another ascent.
        """
        limits, turn_rad = self.task.action_limits, self.turn_rad
        offset_m = max(abs(self.behind_m - self.ahead_m), abs(self.across_m))
        if offset_m <= ALIGNED_M and turn_rad <= ALIGNED_RAD:
            return True
        if offset_m > limits.step_m or turn_rad > limits.turn_rad + ALIGNED_RAD:
            return False
        depth_m = self.position[2] - self.hook_z_m
        thick_m = self.finger_m + SIDE_MARGIN_M
        wide_m = self._half_span_m() + SIDE_MARGIN_M
        for top_m, rear_m, side_m in (
            (CABINET_M[2] * self.scale, math.inf, math.inf),
            (self.rod_z_m + self.radius_m, -self.radius_m, self.side_m),
        ):
            above_m = max(self.tips_z_m - top_m, 0.0)
            left = 1.0 - min(above_m / depth_m, 1.0) if above_m else 1.0
            cos, sin = math.cos(left * turn_rad), math.sin(left * turn_rad)
            along_m = self.behind_m + left * (self.ahead_m - self.behind_m)
            reach_m = thick_m * cos + wide_m * sin
            aside_m = left * abs(self.across_m) + wide_m * cos + thick_m * sin
            if along_m - reach_m < self.front_m or along_m + reach_m > rear_m or aside_m > side_m:
                return False
        return True

    def _half_span_m(self) -> float:
        """Return the distance of the fingers' outer sides from the tool point."""
        gripper = self.robot.gripper
        return gripper.finger_reach_m - (1.0 - self.robot.opening()) * gripper.half_gap_m


def cabinet_parts() -> tuple[Mesh, ...]:
    """Return the five walls of the cabinet; the origin is on the floor below its centre."""
    depth, width, height = CABINET_M
    side = (depth, WALL_M, height - 2 * WALL_M)
    y = (width - WALL_M) / 2
    return (
        transform_mesh(box_mesh((depth, width, WALL_M)), (0.0, 0.0, WALL_M / 2)),
        transform_mesh(box_mesh((depth, width, WALL_M)), (0.0, 0.0, height - WALL_M / 2)),
        transform_mesh(box_mesh(side), (0.0, y, height / 2)),
        transform_mesh(box_mesh(side), (0.0, -y, height / 2)),
        transform_mesh(
            box_mesh((WALL_M, width - 2 * WALL_M, height - 2 * WALL_M)),
            ((WALL_M - depth) / 2, 0.0, height / 2),
        ),
    )


def drawer_parts() -> tuple[Mesh, ...]:
    """Return the parts of the closed drawer and its handle, in the frame of the cabinet."""
    depth, width, height = CABINET_M
    front_x = depth / 2
    back_x = -depth / 2 + WALL_M + PLAY_M
    low, high = WALL_M + PLAY_M, height - WALL_M - PLAY_M
    outer = width - 2 * WALL_M - 2 * PLAY_M
    length = front_x - WALL_M - back_x
    center_x = (back_x + front_x - WALL_M) / 2
    rise = RIM_M - low - DRAWER_WALL_M
    rim_z = low + DRAWER_WALL_M + rise / 2
    side_y = (outer - DRAWER_WALL_M) / 2
    post_length = ROD_OFFSET_M
    post_y = (POST_GAP_M + POST_M) / 2
    post = box_mesh((post_length, POST_M, POST_M))
    rod = rod_mesh(ROD_LENGTH_M, ROD_DIAMETER_M)
    return (
        transform_mesh(
            box_mesh((length, outer, DRAWER_WALL_M)), (center_x, 0.0, low + DRAWER_WALL_M / 2)
        ),
        transform_mesh(box_mesh((length, DRAWER_WALL_M, rise)), (center_x, side_y, rim_z)),
        transform_mesh(box_mesh((length, DRAWER_WALL_M, rise)), (center_x, -side_y, rim_z)),
        transform_mesh(
            box_mesh((DRAWER_WALL_M, outer - 2 * DRAWER_WALL_M, rise)),
            (back_x + DRAWER_WALL_M / 2, 0.0, rim_z),
        ),
        transform_mesh(
            box_mesh((WALL_M, outer, high - low)), (front_x - WALL_M / 2, 0.0, (low + high) / 2)
        ),
        transform_mesh(post, (front_x + post_length / 2, post_y, ROD_HEIGHT_M)),
        transform_mesh(post, (front_x + post_length / 2, -post_y, ROD_HEIGHT_M)),
        transform_mesh(rod, (front_x + post_length, 0.0, ROD_HEIGHT_M)),
    )


def _scaled(parts: Sequence[Mesh], scale: float) -> tuple[Mesh, ...]:
    return tuple(Mesh(vertices * scale, faces) for vertices, faces in parts)
