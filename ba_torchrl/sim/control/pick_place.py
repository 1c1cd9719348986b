"""Open-loop pick and place, in which only the parts with contacts are simulated.

The arm is teleported to the approach if it is free, the fingers are teleported to the smallest
opening without contact, and a held body is teleported with the hand. Grasping, lifting, lowering
and releasing are simulated, so that a grasp holds only by friction. A body that slips between the
fingers is not teleported: its motions are simulated until it is at rest in the gripper or falls.
With ``teleport`` off, all motions are simulated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.contacts import (
    Contact,
    contacts,
    is_any_within,
    nearest_points,
    vertical_force_n,
)
from ba_torchrl.sim.control.close_loop import (
    OPENING_TOLERANCE,
    hand_contacts,
    move_fingers,
    place_in_tool_frame,
    pose_in_tool_frame,
    quintic_time_scaling,
)
from ba_torchrl.sim.geometry import Matrix, Pose, Vector, quaternion_matrix
from ba_torchrl.sim.robots.base import Robot, RobotSleep
from ba_torchrl.sim.robots.gripper import Gripper


class SupportSurface(Protocol):
    """A surface above which the fingers close, and which the arm does not penetrate."""

    @property
    def support_ids(self) -> frozenset[int]:
        """PyBullet ids of the bodies that form the surface."""

    def lowest_tool_m(
        self,
        gripper: Gripper,
        xy: tuple[float, float],
        rotation: Matrix | None = None,
        opening: float = 1.0,
    ) -> float:
        """Return the least height of the tool at which the fingers close above the surface.

        A rotation of None points down; ``opening`` is the fingers' before they close.
        """


class HeldState(NamedTuple):
    """State of `PickPlace`."""

    held: int | None
    """Index of the held body in `World.bodies`; None if the gripper is empty."""
    grasp: Pose | None
    """Pose of the held body in the tool frame."""


@dataclass(frozen=True)
class PickPlaceLimits:
    """Limits of open-loop picks and places."""

    approach_distance_m: float = 0.1
    """Distance from the target, along the approach direction, at which an approach starts."""
    approach_samples_m: tuple[float, ...] = (0.06, 0.03)
    """Distances from the target at which an approach is checked for contacts, besides the target
    itself."""
    acceleration_m_s2: float = 25.0
    """Greatest acceleration of the tool in a simulated straight motion with an empty gripper."""
    held_acceleration_m_s2: float = 15.0
    """The same with a held body."""
    joint_acceleration_rad_s2: float = 60.0
    """Greatest acceleration of a joint in a simulated joint-space motion with an empty gripper."""
    held_joint_acceleration_rad_s2: float = 30.0
    """The same with a held body."""
    closing_stride: float = 0.075
    """Fraction of the opening between the samples at which closing fingers are checked for
    contacts."""
    max_closing_steps: int = 40
    grasp_settle_steps: int = 3
    """Physics steps after closing, in which the grasp force and the contact points build up."""
    lift_height_m: float = 0.005
    """Height by which a grasp is lifted before it is checked."""
    max_slip_m: float = 0.002
    """Displacement of a held body in the tool frame, in a simulated motion, above which it slips. A
    body that is accelerated by `held_acceleration_m_s2` alone lags by 3 mm behind the lift."""
    min_motion_steps: int = 4
    """Least number of physics steps of a simulated straight motion."""
    transit_height_m: float = 0.3
    """Height of the tool between simulated joint-space motions and straight motions."""
    contact_margin_m: float = 5e-4
    """Distance to other bodies below which a pose is not free."""
    pre_place_height_m: float = 0.003
    """Distance from the target at which lowering a held body starts."""
    lowering_steps: int = 2
    release_rest_steps: int = 1
    """Physics steps after lowering in which a body that has no contact yet comes to rest in the
    gripper. Otherwise it would hit its support with the speed of the last step, and tilt."""
    release_opening: float = 0.12
    """Increase of the opening for a release."""
    max_release_steps: int = 10
    max_regrasp_steps: int = 5
    """Physics steps after which a body that is not grasped is no longer held."""
    max_vertical_force_n: float = 40.0
    """Sum of vertical contact forces at which a simulated downward motion stops."""


class PickPlace:
    """Executes picks and places.

    Args:
        teleport: teleport the arm, the fingers and the held body where they have no contacts.
        opening: of the fingers before a pick and after a place, 0 to 1.
        top_down: approach vertically even with a tilted tool, not along its z axis.
    """

    def __init__(
        self,
        robot: Robot,
        surface: SupportSurface,
        *,
        teleport: bool = True,
        opening: float = 1.0,
        top_down: bool = False,
    ) -> None:
        self.robot = robot
        self.world = robot.world
        self.teleport = teleport
        self.opening = opening
        self.top_down = top_down
        self.surface = surface
        self.limits = PickPlaceLimits()
        self.held: Body | None = None
        """The held body, which is hidden from cameras."""
        self.grasp: Pose | None = None
        """Pose of the held body in the tool frame."""
        self.is_out_of_reach = False
        """Whether the last pick or place was out of reach, so that the arm did not move."""
        if teleport:
            self.world.sleepers.append(RobotSleep(robot, lambda: self.held is None))
        self.on_contact: Callable[[], None] = lambda: None
        """Called when the fingers have closed for a pick and before they open for a release."""

    def reset(self) -> None:
        """Teleport the arm to its home configuration with an empty, open gripper."""
        self._detach()
        self.robot.teleport(self.robot.home_joints)
        self.robot.set_opening(self.opening)

    def pick(self, position: Vector, rotation: Matrix) -> Body | None:
        """Grasp at a pose, lift and return to the home configuration.

        The position is raised where the fingers could not close clear of the support surface. The
        result is the held body; None if the grasp failed or the pose is out of reach.
        """
        robot, limits, slips = self.robot, self.limits, False
        robot.set_opening(self.opening)
        if self._approach(self._clear_of_surface(position, rotation), rotation, 0.0):
            self._close_fingers()
            grasps = self._touched_poses()
            self.on_contact()
            reached = robot.tool_frame().position
            above = self._approach_point(reached, rotation, limits.lift_height_m)
            self._move_straight(reached, above, rotation, limits.min_motion_steps)
            body = robot.held_body()
            if body is not None:
                self._attach(body)
                slips = self._has_slipped(grasps.get(body))
                slips = self._retreat(rotation, simulate=slips or not self.teleport)
            elif robot.opening() > OPENING_TOLERANCE:
                slips = self._retreat_with_bad_grasp(rotation)
        self._return_home(simulate=slips or not self.teleport)
        if self.held is None:
            robot.set_opening(self.opening)
        return self.held

    def place(self, position: Vector, rotation: Matrix) -> None:
        """Release the held body at a pose of the tool and return to the home configuration.

        If the pose is out of reach, the body stays in the gripper.
        """
        if self._approach(position, rotation, self.limits.pre_place_height_m):
            reached, limits = self.robot.tool_frame().position, self.limits
            down = self._approach_point(reached, rotation, -limits.pre_place_height_m)
            self._move_straight(reached, down, rotation, limits.lowering_steps)
            if not self._outer_contacts():
                self.world.step(limits.release_rest_steps)
            self.on_contact()
            self._detach()
            self._open_fingers()
            if not self.teleport:
                self._retreat(rotation, simulate=True)
        self._return_home(simulate=not self.teleport)
        if self.held is None:
            self.robot.set_opening(self.opening)

    def get_state(self) -> HeldState:
        """Return the held body and its pose in the tool frame."""
        held = None if self.held is None else self.world.bodies.index(self.held)
        return HeldState(held, self.grasp)

    def set_state(self, state: HeldState) -> None:
        """Restore the state of `get_state`, of a world with the same bodies."""
        self._detach()
        self.held = None if state.held is None else self.world.bodies[state.held]
        self.grasp = state.grasp
        if self.held is not None:
            self.held.is_hidden = True

    # -- held body ---------------------------------------------------------------------------

    def _attach(self, body: Body) -> None:
        """Make a grasped body the held body."""
        self.held = body
        body.is_hidden = True
        self.grasp = pose_in_tool_frame(self.robot, self.held)

    def _detach(self) -> None:
        """Make the held body an ordinary body, without moving it."""
        if self.held is not None:
            self.held.is_hidden = False
        self.held = self.grasp = None

    def _touched_poses(self) -> dict[Body, Pose]:
        """Return the poses in the tool frame of the bodies that the hand touches."""
        touched = {contact.other_id for contact in contacts(self.world.client, self.robot.id)}
        return {
            body: pose_in_tool_frame(self.robot, body)
            for body in self.world.bodies
            if body.id in touched
        }

    def _has_slipped(self, before: Pose | None) -> bool:
        """Whether the held body has moved in the tool frame by more than `max_slip_m`.

        Its pose before the motion is None if the hand did not touch it.
        """
        if before is None:
            return True
        return math.dist(before.position, self.grasp.position) > self.limits.max_slip_m

    def _teleport(self, joints: Sequence[float]) -> None:
        """Teleport the arm and the held body, which keeps its pose in the tool frame."""
        self.robot.teleport(joints)
        if self.held is not None:
            # deletes the contacts of the fingers: Bullet does not rotate their normals
            self.world.detect_collisions()
            place_in_tool_frame(self.robot, self.held, self.grasp)

    def update_grasp(self) -> None:
        """Measure the grasp again, or release the held body if it is no longer grasped.

        After a teleport, PyBullet needs a few steps to detect the contacts of the fingers.
        """
        if self.held is None:
            return
        for _ in range(self.limits.max_regrasp_steps):
            if self.robot.held_body() is self.held:
                self.grasp = pose_in_tool_frame(self.robot, self.held)
                return
            self.world.step()
        self._detach()

    # -- motions -----------------------------------------------------------------------------

    def _approach_point(self, position: Vector, rotation: Matrix, distance_m: float) -> Vector:
        """Return the point at a distance before ``position`` on the approach line."""
        return approach_point(position, rotation, distance_m, top_down=self.top_down)

    def _clear_of_surface(self, position: Vector, rotation: Matrix) -> Vector:
        """Return the point, raised if necessary so that the fingers close clear of the surface."""
        x, y, z = position
        lowest = self.surface.lowest_tool_m(self.robot.gripper, (x, y), rotation, self.opening)
        return x, y, max(z, lowest)

    def _solve_joints(self, position: Vector, rotation: Matrix) -> list[float] | None:
        return self.robot.inverse_kinematics(position, rotation, self.robot.joints)

    def _approach(self, position: Vector, rotation: Matrix, clearance_m: float) -> bool:
        """Move the tool along the approach line to a target, or to a clearance before it.

        Return whether the approach is within reach; if not, the arm does not move.
        """
        end = self._approach_point(position, rotation, clearance_m)
        path = plan_approach(
            self.robot, self.surface.support_ids, self.limits, end, rotation, top_down=self.top_down
        )
        self.is_out_of_reach = path is None
        if path is None:
            return False
        if self.teleport and self._teleport_along(path[1:]):
            return True
        start = self._approach_point(end, rotation, self.limits.approach_distance_m)
        if self.teleport:
            self._teleport(path[0])
        if not self.teleport or not self._is_clear():
            self._descend_to(start, rotation)
        self._move_straight(start, end, rotation)
        self.update_grasp()
        return True

    def _teleport_along(self, path: Sequence[Sequence[float]]) -> bool:
        """Teleport through joint positions; return False at the first contact."""
        for joints in path:
            self._teleport(joints)
            if self._is_in_contact():
                return False
        return True

    def _retreat(self, rotation: Matrix, *, simulate: bool) -> bool:
        """Retract the tool against the approach direction, by teleport if the path is free.

        Return whether the held body slipped between the fingers.
        """
        start = self.robot.tool_frame().position
        if not simulate:
            joints_at_start = self.robot.joints
            path = [
                self._solve_joints(self._approach_point(start, rotation, distance), rotation)
                for distance in reversed(self.limits.approach_samples_m)
            ]
            if None not in path and self._teleport_along(path):
                return False
            self._teleport(joints_at_start)
        before = self.grasp
        end = self._approach_point(start, rotation, self.limits.approach_distance_m)
        self._move_straight(start, end, rotation)
        self.update_grasp()
        return self.held is not None and self._has_slipped(before)

    def _retreat_with_bad_grasp(self, rotation: Matrix) -> bool:
        """Simulate a retreat with fingers that are neither closed nor hold a body.

        On the way, fingers stopped by an obstacle go on closing. What is then not held is released.
        Return whether a body is held, which may still slip.
        """
        self._retreat(rotation, simulate=True)
        body = self.robot.held_body()
        if body is None:
            move_fingers(self.robot, self.opening, self.limits.max_closing_steps)
            return False
        self._attach(body)
        return True

    def _descend_to(self, start: Vector, rotation: Matrix) -> None:
        """Move above the start of an approach, and simulate the descent to it."""
        high = (*start[:2], max(self.limits.transit_height_m, start[2]))
        joints = self._solve_joints(high, rotation)
        if joints is None:
            high, joints = start, self._solve_joints(start, rotation)
        if self.teleport:
            self._teleport(joints)
        else:
            self._move_joints(joints)
        self._move_straight(high, start, rotation)

    def _return_home(self, *, simulate: bool) -> None:
        """Move the arm to its home configuration, by simulation or teleport."""
        if not simulate:
            self._teleport(self.robot.home_joints)
            return
        tool = self.robot.tool_frame()
        high = (*tool.position[:2], self.limits.transit_height_m)
        if tool.position[2] < high[2]:
            rotation = quaternion_matrix(tool.orientation)
            self._move_straight(tool.position, high, rotation)
        self._move_joints(self.robot.home_joints)
        self.update_grasp()

    def _move_straight(
        self, start: Vector, end: Vector, rotation: Matrix, count: int | None = None
    ) -> None:
        """Simulate a straight motion of the tool.

        The motion ends where it is out of reach, or, if downward, at the force limit. A number of
        physics steps of None is the least within the acceleration limits.
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
        """Simulate a joint-space motion of the arm."""
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
        return hand_contacts(self.robot, self.held)

    def _is_clear(self) -> bool:
        """Whether hand and held body are clear of all other bodies at their current poses.

        This computes closest points, not contact points: contacts of bodies that penetrate each
        other affect later steps through caches of the engine that no saved state contains.
        """
        client, robot = self.world.client, self.robot
        own = [robot.id] if self.held is None else [robot.id, self.held.id]
        others = {self.world.floor, *(body.id for body in self.world.bodies)} - {*own}
        return not any(
            point.body_id != robot.id or point.link not in robot.non_colliding_links
            for body_id in own
            for other_id in sorted(others)
            for point in nearest_points(client, body_id, other_id, self.limits.contact_margin_m)
        )

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


PEAK_ACCELERATION = 10 / math.sqrt(3)
"""Greatest acceleration of `quintic_time_scaling` for a unit distance and a unit duration."""
MAX_UNCHECKED_TILT_COSINE = 0.86
"""Within 30 degrees of the vertical, neither hand nor arm can reach below the fingertips on level
ground. On a slope, contact stops the hand."""


def approach_point(
    position: Vector, rotation: Matrix, distance_m: float, *, top_down: bool = False
) -> Vector:
    """Return the point at a distance before ``position`` on the approach line.

    The line is the z axis of the tool, or with ``top_down`` the vertical.
    """
    away = (0.0, 0.0, 1.0) if top_down else tuple(-row[2] for row in rotation)
    return tuple(p + distance_m * a for p, a in zip(position, away, strict=True))


def plan_approach(
    robot: Robot,
    support_ids: Iterable[int],
    limits: PickPlaceLimits,
    end: Vector,
    rotation: Matrix,
    *,
    top_down: bool = False,
) -> list[list[float]] | None:
    """Return the arm joints at samples of an approach to a tool point, the first at its start.

    It is None if the approach is out of reach: a sample has no inverse kinematics, or hand or arm
    penetrate the support surface at the start or at the end.
    """
    path = []
    for distance in (limits.approach_distance_m, *limits.approach_samples_m, 0.0):
        point = approach_point(end, rotation, distance, top_down=top_down)
        joints = robot.inverse_kinematics(point, rotation, robot.joints)
        if joints is None:
            return None
        path.append(joints)
    is_steep = -rotation[2][2] > MAX_UNCHECKED_TILT_COSINE
    if not is_steep and any(robot.penetrates(support_ids, path[i]) for i in (0, -1)):
        return None
    return path
