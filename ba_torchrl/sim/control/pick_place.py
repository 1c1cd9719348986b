"""Open-loop pick and place: the physics that a grasp and a release need, and no more.

What touches nothing is not simulated: the arm is teleported above the object if the way down is
free, the fingers are closed up to the last notch before they touch, and what is held is carried
rigidly. Closing, lifting off, setting down and letting go are physics; a grasp holds by friction or
it does not. With ``teleport`` off every centimetre is simulated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.contacts import Contact, is_any_within, outer_contacts, vertical_force_n
from ba_torchrl.sim.control.close_loop import move_fingers, quintic_time_scaling
from ba_torchrl.sim.geometry import (
    Matrix,
    Pose,
    Vector,
    bullet_compose,
    bullet_inverse,
    quaternion_matrix,
)
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.robots.gripper import Gripper


@dataclass(frozen=True)
class PickPlaceLimits:
    """Distances and step counts of picking and placing."""

    approach_distance_m: float = 0.1
    """Where a simulated approach starts, along the tool's axis."""
    approach_samples_m: tuple[float, ...] = (0.06, 0.03)
    """Where on the way down it is tested that nothing is in the way, besides its end."""
    acceleration_m_s2: float = 25.0
    """Greatest acceleration of a simulated way; the arm's motors brake it in time."""
    held_acceleration_m_s2: float = 15.0
    """The same with something in the gripper."""
    joint_acceleration_rad_s2: float = 60.0
    """Greatest acceleration of a joint in a simulated swing."""
    held_joint_acceleration_rad_s2: float = 30.0
    closing_stride: float = 0.075
    """Share of the opening by which fingers close without simulation."""
    max_closing_steps: int = 40
    grasp_settle_steps: int = 3
    """Steps after which closed fingers press with all their force, on more than one point."""
    lift_height_m: float = 0.005
    min_motion_steps: int = 4
    """Least number of steps of a simulated way."""
    transit_height_m: float = 0.3
    """Height of the tool at which simulated swings start and end."""
    contact_margin_m: float = 5e-4
    """Closer than this, a way is not free."""
    pre_place_height_m: float = 0.003
    """Height above its place from which an object is lowered."""
    lowering_steps: int = 2
    release_opening: float = 0.12
    """Share of the opening by which fingers part to let go."""
    max_release_steps: int = 10
    max_regrasp_steps: int = 5
    """Steps after which a body that is not squeezed is no longer held."""
    max_vertical_force_n: float = 40.0
    """A simulated approach stops when it meets this force."""


PEAK_ACCELERATION = 10 / math.sqrt(3)
"""Of `quintic_time_scaling`, which covers 1 in a time of 1."""


LowestToolHeight = Callable[[Gripper, tuple[float, float], Matrix, float], float]
"""From a gripper, x and y, the tool's rotation and the opening to the least height of the tool at
which the fingers close above the support surface."""


class HeldState(NamedTuple):
    """What `PickPlace` remembers."""

    held: int | None
    """Its place among the world's bodies."""
    grasp: Pose | None


class PickPlace:
    """Picks and places with a robot.

    Args:
        robot: the robot.
        teleport: skip the simulation of free travel.
        opening: how far the fingers open, 0 to 1.
        top_down: come from straight above even where the tool is tilted, instead of along its
            axis.
        lowest_tool_m: least height of the tool at a place; that above the world's floor if None.
        limits: distances and step counts.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        teleport: bool = True,
        opening: float = 1.0,
        top_down: bool = False,
        lowest_tool_m: LowestToolHeight | None = None,
        limits: PickPlaceLimits | None = None,
    ) -> None:
        self.robot = robot
        self.world = robot.world
        self.teleport = teleport
        self.opening = opening
        self.top_down = top_down
        self.lowest_tool_m = lowest_tool_m
        self.limits = limits or PickPlaceLimits()
        self.held: Body | None = None
        """What is in the gripper; it is hidden from cameras, as is the arm."""
        self.grasp: Pose | None = None
        """Its pose in the frame of the tool."""

    def reset(self) -> None:
        """Empty the gripper and go home, without moving anything else."""
        self._detach()
        self.robot.teleport(self.robot.home_joints)
        self.robot.set_opening(self.opening)

    def pick(self, position: Vector, rotation: Matrix) -> Body | None:
        """Grasp what is at a pose, lift it and go home.

        The tool stays so high that its fingers can close above the support surface.

        Args:
            position: of the tool point, metres.
            rotation: of the tool.

        Returns:
            What is held at the end; None if nothing is, or the pose is out of reach.
        """
        robot, limits = self.robot, self.limits
        robot.set_opening(self.opening)
        if self._approach(self._clear_of_surface(position, rotation), rotation, 0.0):
            self._close_fingers()
            reached = robot.tool_frame()[0]
            above = self._approach_point(reached, rotation, limits.lift_height_m)
            self._move_straight(reached, above, rotation, limits.min_motion_steps)
            body = robot.held_body()
            if body is not None:
                self._attach(body)
                self._retreat(rotation)
        self._return_home()
        if self.held is None:
            robot.set_opening(self.opening)
        return self.held

    def place(self, position: Vector, rotation: Matrix) -> None:
        """Set down what is held at a pose of the tool, let go and go home.

        Out of reach, it stays in the gripper.
        """
        if self._approach(position, rotation, self.limits.pre_place_height_m):
            reached = self.robot.tool_frame()[0]
            down = self._approach_point(reached, rotation, -self.limits.pre_place_height_m)
            self._move_straight(reached, down, rotation, self.limits.lowering_steps)
            self._detach()
            self._open_fingers()
            if not self.teleport:
                self._retreat(rotation)
        self._return_home()
        if self.held is None:
            self.robot.set_opening(self.opening)

    def get_state(self) -> HeldState:
        """Return what is held, and how."""
        held = None if self.held is None else self.world.bodies.index(self.held)
        return HeldState(held, self.grasp)

    def set_state(self, state: HeldState) -> None:
        """Take up what `get_state` returned."""
        self._detach()
        self.held = None if state.held is None else self.world.bodies[state.held]
        self.grasp = state.grasp
        if self.held is not None:
            self.held.is_hidden = True

    # -- what is held ------------------------------------------------------------------------

    def _attach(self, body: Body) -> None:
        self.held = body
        body.is_hidden = True
        self._measure_grasp()

    def _detach(self) -> None:
        if self.held is not None:
            self.held.is_hidden = False
        self.held = self.grasp = None

    def _measure_grasp(self) -> None:
        """Measure where in the gripper the body is now."""
        to_tool = bullet_inverse(self.robot.tool_frame())
        self.grasp = bullet_compose(to_tool, self.held.pose)

    def _teleport(self, joints: Sequence[float]) -> None:
        """Teleport the arm, and rigidly with it what is held."""
        self.robot.teleport(joints)
        if self.held is not None:
            self.world.detect_collisions()  # contacts end: Bullet would not turn their normals
            self.held.set_pose(*bullet_compose(self.robot.tool_frame(), self.grasp))

    def update_grasp(self) -> None:
        """Take note if what was held slipped out.

        Contacts need a step or two to be found again where body and hand were put; only a body
        that stays lost is.
        """
        if self.held is None:
            return
        for _ in range(self.limits.max_regrasp_steps):
            if self.robot.held_body() is self.held:
                self._measure_grasp()
                return
            self.world.step()
        self._detach()

    # -- ways --------------------------------------------------------------------------------

    def _approach_point(self, position: Vector, rotation: Matrix, height_m: float) -> Vector:
        """Return the point from which the tool comes down to ``position``."""
        up = (0.0, 0.0, 1.0) if self.top_down else tuple(-row[2] for row in rotation)
        return tuple(p + height_m * u for p, u in zip(position, up, strict=True))

    def _clear_of_surface(self, position: Vector, rotation: Matrix) -> Vector:
        """Return the point, raised if necessary so that the fingers close above the surface."""
        x, y, z = position
        gripper = self.robot.gripper
        if self.lowest_tool_m is None:
            return x, y, max(z, gripper.lowest_tool_m(rotation, self.opening))
        return x, y, max(z, self.lowest_tool_m(gripper, (x, y), rotation, self.opening))

    def _tool_rotation(self) -> Matrix:
        return quaternion_matrix(self.robot.tool_frame().orientation)

    def _solve_joints(self, position: Vector, rotation: Matrix) -> list[float] | None:
        return self.robot.inverse_kinematics(position, rotation, self.robot.joints)

    def _approach(self, position: Vector, rotation: Matrix, clearance_m: float) -> bool:
        """Bring the tool ``clearance_m`` above a pose; return False if that is out of reach."""
        limits = self.limits
        end = self._approach_point(position, rotation, clearance_m)
        heights = (limits.approach_distance_m, *limits.approach_samples_m, 0.0)
        way = [
            self._solve_joints(self._approach_point(end, rotation, height), rotation)
            for height in heights
        ]
        if any(joints is None for joints in way):
            return False
        if self.teleport:
            for joints in way[1:]:
                self._teleport(joints)
                if self._touches_anything():
                    break
            else:
                return True
            self._teleport(way[0])
        else:
            self._move_to_approach(end, rotation)
        self._move_straight(
            self._approach_point(end, rotation, limits.approach_distance_m), end, rotation, None
        )
        self.update_grasp()
        return True

    def _retreat(self, rotation: Matrix) -> None:
        """Go up from where the tool is, in simulation unless nothing is in the way."""
        start = self.robot.tool_frame()[0]
        if self.teleport:
            here = self.robot.joints
            for height in reversed(self.limits.approach_samples_m):
                joints = self._solve_joints(self._approach_point(start, rotation, height), rotation)
                if joints is None:
                    break
                self._teleport(joints)
                if self._touches_anything():
                    break
            else:
                return
            self._teleport(here)
        self._move_straight(
            start,
            self._approach_point(start, rotation, self.limits.approach_distance_m),
            rotation,
            None,
        )
        self.update_grasp()

    def _move_to_approach(self, end: Vector, rotation: Matrix) -> None:
        """Swing high above everything, then come down to where the approach starts."""
        start = self._approach_point(end, rotation, self.limits.approach_distance_m)
        high = (*start[:2], max(self.limits.transit_height_m, start[2]))
        joints = self._solve_joints(high, rotation)
        if joints is None:
            high, joints = start, self._solve_joints(start, rotation)
        self._move_joints(joints)
        self._move_straight(high, start, rotation, None)

    def _return_home(self) -> None:
        if self.teleport:
            self._teleport(self.robot.home_joints)
        else:
            x, y, z = self.robot.tool_frame()[0]
            rotation = self._tool_rotation()
            if z < self.limits.transit_height_m:
                self._move_straight((x, y, z), (x, y, self.limits.transit_height_m), rotation, None)
            self._move_joints(self.robot.home_joints)
            self.update_grasp()

    def _move_straight(
        self, start: Vector, end: Vector, rotation: Matrix, count: int | None
    ) -> None:
        """Simulate a straight way of the tool; stop where it presses or leaves the reach.

        Args:
            start: of the tool point.
            end: of the tool point.
            rotation: of the tool.
            count: number of steps; if None, as many as the limits of acceleration ask for.
        """
        limits = self.limits
        if count is None:
            most = limits.acceleration_m_s2
            if self.held is not None:
                most = limits.held_acceleration_m_s2
            count = max(limits.min_motion_steps, self._num_steps(math.dist(start, end), most))
        goes_down = end[2] < start[2]
        for i in range(1, count + 1):
            place = quintic_time_scaling(i / count)
            point = tuple(s + place * (e - s) for s, e in zip(start, end, strict=True))
            joints = self._solve_joints(point, rotation)
            if joints is None:
                return
            before = self.robot.joints
            self.robot.command(joints)
            self.world.step()
            if goes_down and vertical_force_n(self._outer_contacts()) > limits.max_vertical_force_n:
                self.robot.command(before)
                self.world.step()
                return

    def _move_joints(self, joints: Sequence[float]) -> None:
        """Simulate a smooth move of the arm in joint angles."""
        start = self.robot.joints
        turns = [e - s for s, e in zip(start, joints, strict=True)]
        limits = self.limits
        most = (
            limits.joint_acceleration_rad_s2
            if self.held is None
            else limits.held_joint_acceleration_rad_s2
        )
        count = max(2, self._num_steps(max(map(abs, turns)), most))
        for i in range(1, count + 1):
            place = quintic_time_scaling(i / count)
            self.robot.command([s + place * t for s, t in zip(start, turns, strict=True)])
            self.world.step()

    def _num_steps(self, length: float, acceleration: float) -> int:
        """Return the number of steps for a smooth way whose acceleration is never above a limit."""
        duration_s = math.sqrt(PEAK_ACCELERATION * length / acceleration)
        return math.ceil(duration_s / self.world.physics.time_step_s)

    # -- contacts ----------------------------------------------------------------------------

    def _outer_contacts(self) -> list[Contact]:
        """Return the contacts of the hand and the held body with everything else."""
        held = () if self.held is None else (self.held.id,)
        return outer_contacts(self.world.client, self.robot.id, *held)

    def _touches_anything(self) -> bool:
        self.world.detect_collisions()
        return is_any_within(self._outer_contacts(), self.limits.contact_margin_m)

    # -- fingers -----------------------------------------------------------------------------

    def _close_fingers(self) -> None:
        """Close the fingers until they meet something, or each other."""
        if self.teleport:
            free = self.opening
            for i in range(1, math.ceil(self.opening / self.limits.closing_stride) + 1):
                opening = max(self.opening - i * self.limits.closing_stride, 0.0)
                self.robot.set_opening(opening)
                if self._touches_anything():
                    break
                free = opening
            self.robot.set_opening(free)
        move_fingers(self.robot, 0.0, self.limits.max_closing_steps)
        self.world.step(self.limits.grasp_settle_steps)

    def _open_fingers(self) -> None:
        """Let go of what is between the fingers, without pushing what stands beside it."""
        limits = self.limits
        if not self.teleport:
            self.robot.rebuild_contacts()  # the hand turned since it closed
        wanted = min(self.robot.opening() + limits.release_opening, self.opening)
        move_fingers(self.robot, wanted, limits.max_release_steps)
