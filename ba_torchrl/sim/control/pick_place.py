"""Open-loop pick and place, of which only the parts with contacts are simulated.

The arm is teleported to the approach if it is free, the fingers are teleported to the smallest
opening without contact, and a held body is teleported with the hand. Grasping, lifting, lowering
and releasing are simulated, so that a grasp holds only by friction. With ``teleport`` off, all
motions are simulated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.contacts import Contact, is_any_within, outer_contacts, vertical_force_n
from ba_torchrl.sim.control.close_loop import move_fingers, quintic_time_scaling
from ba_torchrl.sim.control.limits import PickPlaceLimits
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

PEAK_ACCELERATION = 10 / math.sqrt(3)
"""Greatest acceleration of `quintic_time_scaling` for a unit distance and a unit duration."""


LowestToolHeight = Callable[[Gripper, tuple[float, float], Matrix, float], float]
"""Function of the gripper, x and y of the tool, its rotation and the opening. It returns the least
height of the tool at which the fingers close clear of the support surface."""


class HeldState(NamedTuple):
    """State of `PickPlace`."""

    held: int | None
    """Index of the held body in `World.bodies`; None if the gripper is empty."""
    grasp: Pose | None
    """Pose of the held body in the tool frame."""


class PickPlace:
    """Executes picks and places.

    Args:
        robot: the robot.
        teleport: teleport the arm, the fingers and the held body where they have no contacts.
        opening: of the fingers before a pick and after a place, 0 to 1.
        top_down: approach vertically even with a tilted tool, instead of along the z axis of the
            tool.
        lowest_tool_m: least height of the tool above the support surface; None means that above
            the floor of the world.
        limits: distances, accelerations and step counts.
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
        """The held body, which is hidden from cameras."""
        self.grasp: Pose | None = None
        """Pose of the held body in the tool frame."""
        self.on_contact: Callable[[], None] | None = None
        """Called when the fingers have closed for a pick and before they open for a release."""

    def reset(self) -> None:
        """Teleport the arm to its home configuration with an empty, open gripper."""
        self._detach()
        self.robot.teleport(self.robot.home_joints)
        self.robot.set_opening(self.opening)

    def pick(self, position: Vector, rotation: Matrix) -> Body | None:
        """Grasp at a pose, lift and return to the home configuration.

        The position is raised where the fingers could not close clear of the support surface.

        Args:
            position: of the tool point at the grasp, metres.
            rotation: of the tool.

        Returns:
            The held body; None if the grasp failed or the pose is out of reach.
        """
        robot, limits = self.robot, self.limits
        robot.set_opening(self.opening)
        if self._approach(self._clear_of_surface(position, rotation), rotation, 0.0):
            self._close_fingers()
            self._notify_contact()
            reached = robot.tool_frame().position
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
        """Release the held body at a pose of the tool and return to the home configuration.

        If the pose is out of reach, the body stays in the gripper.

        Args:
            position: of the tool point at the release, metres.
            rotation: of the tool.
        """
        if self._approach(position, rotation, self.limits.pre_place_height_m):
            reached = self.robot.tool_frame().position
            down = self._approach_point(reached, rotation, -self.limits.pre_place_height_m)
            self._move_straight(reached, down, rotation, self.limits.lowering_steps)
            self._notify_contact()
            self._detach()
            self._open_fingers()
            if not self.teleport:
                self._retreat(rotation)
        self._return_home()
        if self.held is None:
            self.robot.set_opening(self.opening)

    def get_state(self) -> HeldState:
        """Return the held body and its pose in the tool frame."""
        held = None if self.held is None else self.world.bodies.index(self.held)
        return HeldState(held, self.grasp)

    def set_state(self, state: HeldState) -> None:
        """Restore the held body and its pose in the tool frame.

        Args:
            state: from `get_state`, in a world with the same bodies.
        """
        self._detach()
        self.held = None if state.held is None else self.world.bodies[state.held]
        self.grasp = state.grasp
        if self.held is not None:
            self.held.is_hidden = True

    def _notify_contact(self) -> None:
        if self.on_contact is not None:
            self.on_contact()

    # -- held body ---------------------------------------------------------------------------

    def _attach(self, body: Body) -> None:
        """Make a grasped body the held body."""
        self.held = body
        body.is_hidden = True
        self._measure_grasp()

    def _detach(self) -> None:
        """Make the held body an ordinary body, without moving it."""
        if self.held is not None:
            self.held.is_hidden = False
        self.held = self.grasp = None

    def _measure_grasp(self) -> None:
        """Measure the pose of the held body in the tool frame."""
        to_tool = bullet_inverse(self.robot.tool_frame())
        self.grasp = bullet_compose(to_tool, self.held.pose)

    def _teleport(self, joints: Sequence[float]) -> None:
        """Teleport the arm and the held body, which keeps its pose in the tool frame."""
        self.robot.teleport(joints)
        if self.held is not None:
            # deletes the contacts of the fingers: Bullet does not rotate their normals
            self.world.detect_collisions()
            self.held.set_pose(*bullet_compose(self.robot.tool_frame(), self.grasp))

    def update_grasp(self) -> None:
        """Measure the grasp again, or release the held body if it is no longer grasped.

        After a teleport, PyBullet needs a few steps to detect the contacts of the fingers.
        """
        if self.held is None:
            return
        for _ in range(self.limits.max_regrasp_steps):
            if self.robot.held_body() is self.held:
                self._measure_grasp()
                return
            self.world.step()
        self._detach()

    # -- motions -----------------------------------------------------------------------------

    def _approach_point(self, position: Vector, rotation: Matrix, distance_m: float) -> Vector:
        """Return the point at a distance before ``position`` on the approach line."""
        away = (0.0, 0.0, 1.0) if self.top_down else tuple(-row[2] for row in rotation)
        return tuple(p + distance_m * a for p, a in zip(position, away, strict=True))

    def _clear_of_surface(self, position: Vector, rotation: Matrix) -> Vector:
        """Return the point, raised if necessary so that the fingers close clear of the surface."""
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
        """Move the tool along the approach line to a target, or to a clearance before it.

        Args:
            position: target of the tool point, metres.
            rotation: of the tool.
            clearance_m: distance from the target, along the approach direction.

        Returns:
            Whether the approach is within reach; if not, the arm does not move.
        """
        limits = self.limits
        end = self._approach_point(position, rotation, clearance_m)
        distances = (limits.approach_distance_m, *limits.approach_samples_m, 0.0)
        path = [
            self._solve_joints(self._approach_point(end, rotation, distance), rotation)
            for distance in distances
        ]
        if any(joints is None for joints in path):
            return False
        if self.teleport:
            for joints in path[1:]:
                self._teleport(joints)
                if self._is_in_contact():
                    break
            else:
                return True
            self._teleport(path[0])
        else:
            self._move_to_approach(end, rotation)
        self._move_straight(
            self._approach_point(end, rotation, limits.approach_distance_m), end, rotation, None
        )
        self.update_grasp()
        return True

    def _retreat(self, rotation: Matrix) -> None:
        """Retract the tool against the approach direction, simulated unless the path is free."""
        start = self.robot.tool_frame().position
        if self.teleport:
            joints_at_start = self.robot.joints
            for distance in reversed(self.limits.approach_samples_m):
                joints = self._solve_joints(
                    self._approach_point(start, rotation, distance), rotation
                )
                if joints is None:
                    break
                self._teleport(joints)
                if self._is_in_contact():
                    break
            else:
                return
            self._teleport(joints_at_start)
        self._move_straight(
            start,
            self._approach_point(start, rotation, self.limits.approach_distance_m),
            rotation,
            None,
        )
        self.update_grasp()

    def _move_to_approach(self, end: Vector, rotation: Matrix) -> None:
        """Simulate a motion to the start of an approach, at the transit height first."""
        start = self._approach_point(end, rotation, self.limits.approach_distance_m)
        high = (*start[:2], max(self.limits.transit_height_m, start[2]))
        joints = self._solve_joints(high, rotation)
        if joints is None:
            high, joints = start, self._solve_joints(start, rotation)
        self._move_joints(joints)
        self._move_straight(high, start, rotation, None)

    def _return_home(self) -> None:
        """Move the arm to its home configuration, simulated without `teleport`."""
        if self.teleport:
            self._teleport(self.robot.home_joints)
        else:
            x, y, z = self.robot.tool_frame().position
            rotation = self._tool_rotation()
            if z < self.limits.transit_height_m:
                self._move_straight((x, y, z), (x, y, self.limits.transit_height_m), rotation, None)
            self._move_joints(self.robot.home_joints)
            self.update_grasp()

    def _move_straight(
        self, start: Vector, end: Vector, rotation: Matrix, count: int | None
    ) -> None:
        """Simulate a straight motion of the tool.

        The motion ends where it is out of reach, or, if downward, at the force limit.

        Args:
            start: position of the tool point at the start, metres.
            end: position of the tool point at the end, metres.
            rotation: of the tool.
            count: number of physics steps; None means the least within the acceleration limits.
        """
        limits = self.limits
        if count is None:
            acceleration = limits.acceleration_m_s2
            if self.held is not None:
                acceleration = limits.held_acceleration_m_s2
            count = max(
                limits.min_motion_steps, self._num_steps(math.dist(start, end), acceleration)
            )
        goes_down = end[2] < start[2]
        for i in range(1, count + 1):
            fraction = quintic_time_scaling(i / count)
            point = tuple(s + fraction * (e - s) for s, e in zip(start, end, strict=True))
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
        """Simulate a joint-space motion of the arm with quintic time scaling."""
        start = self.robot.joints
        deltas = [e - s for s, e in zip(start, joints, strict=True)]
        limits = self.limits
        acceleration = (
            limits.joint_acceleration_rad_s2
            if self.held is None
            else limits.held_joint_acceleration_rad_s2
        )
        count = max(2, self._num_steps(max(map(abs, deltas)), acceleration))
        for i in range(1, count + 1):
            fraction = quintic_time_scaling(i / count)
            self.robot.command([s + fraction * d for s, d in zip(start, deltas, strict=True)])
            self.world.step()

    def _num_steps(self, length: float, acceleration: float) -> int:
        """Return the least number of steps of a quintic motion within an acceleration limit."""
        duration_s = math.sqrt(PEAK_ACCELERATION * length / acceleration)
        return math.ceil(duration_s / self.world.physics.time_step_s)

    # -- contacts ----------------------------------------------------------------------------

    def _outer_contacts(self) -> list[Contact]:
        """Return the contacts of the hand and the held body with other bodies."""
        held = () if self.held is None else (self.held.id,)
        return outer_contacts(self.world.client, self.robot.id, *held)

    def _is_in_contact(self) -> bool:
        self.world.detect_collisions()
        return is_any_within(self._outer_contacts(), self.limits.contact_margin_m)

    # -- fingers -----------------------------------------------------------------------------

    def _close_fingers(self) -> None:
        """Close the fingers until they are stopped by a contact."""
        if self.teleport:
            free = self.opening
            for i in range(1, math.ceil(self.opening / self.limits.closing_stride) + 1):
                opening = max(self.opening - i * self.limits.closing_stride, 0.0)
                self.robot.set_opening(opening)
                if self._is_in_contact():
                    break
                free = opening
            self.robot.set_opening(free)
        move_fingers(self.robot, 0.0, self.limits.max_closing_steps)
        self.world.step(self.limits.grasp_settle_steps)

    def _open_fingers(self) -> None:
        """Open the fingers only as far as a release needs, to avoid pushing bodies beside them."""
        limits = self.limits
        if not self.teleport:
            self.robot.rebuild_contacts()  # the hand may have rotated since it closed
        opening = min(self.robot.opening() + limits.release_opening, self.opening)
        move_fingers(self.robot, opening, limits.max_release_steps)
