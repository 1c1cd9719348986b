"""Open-loop pick and place, of which only the parts with contacts are simulated.

The arm is teleported to the approach if it is free, the fingers are teleported to the smallest
opening without contact, and a held body is teleported with the hand. Grasping, lifting, lowering
and releasing are simulated, so that a grasp holds only by friction. A body that slips between the
fingers is not teleported: its motions are simulated until it is at rest in the gripper or falls.
With ``teleport`` off, all motions are simulated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.contacts import contacts, is_any_within
from ba_torchrl.sim.control.approach import approach_point, plan_approach
from ba_torchrl.sim.control.close_loop import OPENING_TOLERANCE, move_fingers
from ba_torchrl.sim.control.held_body import place_in_tool_frame, pose_in_tool_frame
from ba_torchrl.sim.control.limits import PickPlaceLimits
from ba_torchrl.sim.control.support_surface import Floor, SupportSurface
from ba_torchrl.sim.control.tool_motion import ToolMotion
from ba_torchrl.sim.geometry import (
    Matrix,
    Pose,
    Vector,
    quaternion_matrix,
)
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.robots.sleep import RobotSleep


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
        top_down: approach vertically even with a tilted tool, not along its z axis.
        surface: support surface; None means the floor of the world.
        limits: distances, accelerations and step counts.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        teleport: bool = True,
        opening: float = 1.0,
        top_down: bool = False,
        surface: SupportSurface | None = None,
        limits: PickPlaceLimits | None = None,
    ) -> None:
        self.robot = robot
        self.world = robot.world
        self.teleport = teleport
        self.opening = opening
        self.top_down = top_down
        self.surface = surface or Floor(self.world.floor)
        self.limits = limits or PickPlaceLimits()
        self.motion = ToolMotion(robot, self.limits)
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

        The position is raised where the fingers could not close clear of the support surface.

        Args:
            position: of the tool point at the grasp, metres.
            rotation: of the tool.

        Returns:
            The held body; None if the grasp failed or the pose is out of reach.
        """
        robot, limits, slips = self.robot, self.limits, False
        robot.set_opening(self.opening)
        if self._approach(self._clear_of_surface(position, rotation), rotation, 0.0):
            self._close_fingers()
            grasps = self._touched_poses()
            self.on_contact()
            reached = robot.tool_frame().position
            above = self._approach_point(reached, rotation, limits.lift_height_m)
            self.motion.move_straight(reached, above, rotation, None, limits.min_motion_steps)
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

        Args:
            position: of the tool point at the release, metres.
            rotation: of the tool.
        """
        if self._approach(position, rotation, self.limits.pre_place_height_m):
            reached, limits = self.robot.tool_frame().position, self.limits
            down = self._approach_point(reached, rotation, -limits.pre_place_height_m)
            self.motion.move_straight(reached, down, rotation, self.held, limits.lowering_steps)
            if not self.motion.outer_contacts(self.held):
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
        """Return the poses in the tool frame of the bodies that the hand touches.

        There are none if slipping is not tested.
        """
        if not self.limits.tests_slip:
            return {}
        touched = {contact.other_id for contact in contacts(self.world.client, self.robot.id)}
        return {
            body: pose_in_tool_frame(self.robot, body)
            for body in self.world.bodies
            if body.id in touched
        }

    def _has_slipped(self, before: Pose | None) -> bool:
        """Whether the held body has moved in the tool frame by more than `max_slip_m`.

        Args:
            before: its pose in the tool frame before a motion; None if the hand did not touch it.
        """
        if not self.limits.tests_slip:
            return False
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

        Args:
            position: target of the tool point, metres.
            rotation: of the tool.
            clearance_m: distance from the target, along the approach direction.

        Returns:
            Whether the approach is within reach; if not, the arm does not move.
        """
        end = self._approach_point(position, rotation, clearance_m)
        path = plan_approach(
            self.robot,
            self.surface.support_ids,
            self.limits,
            end,
            rotation,
            top_down=self.top_down,
        )
        self.is_out_of_reach = path is None
        if path is None:
            return False
        if self.teleport and self._teleport_along(path[1:]):
            return True
        start = self._approach_point(end, rotation, self.limits.approach_distance_m)
        if self.teleport:
            self._teleport(path[0])
        if not self.teleport or not self.motion.is_clear(self.held):
            self._descend_to(start, rotation)
        self.motion.move_straight(start, end, rotation, self.held)
        self.update_grasp()
        return True

    def _teleport_along(self, path: Sequence[Sequence[float]]) -> bool:
        """Teleport through joint positions until the first contact.

        Returns:
            Whether all of them are free of contacts.
        """
        for joints in path:
            self._teleport(joints)
            if self._is_in_contact():
                return False
        return True

    def _retreat(self, rotation: Matrix, *, simulate: bool) -> bool:
        """Retract the tool against the approach direction.

        Args:
            rotation: of the tool.
            simulate: simulate the motion even if the path is free.

        Returns:
            Whether the held body slipped between the fingers.
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
        self.motion.move_straight(start, end, rotation, self.held)
        self.update_grasp()
        return self.held is not None and self._has_slipped(before)

    def _retreat_with_bad_grasp(self, rotation: Matrix) -> bool:
        """Simulate a retreat with fingers that are neither closed nor hold a body.

        On the way, fingers stopped by an obstacle go on closing. What is then not held is released.

        Returns:
            Whether a body is held, which may still slip.
        """
        self._retreat(rotation, simulate=True)
        body = self.robot.held_body()
        if body is None:
            move_fingers(self.robot, self.opening, self.limits.max_closing_steps)
            return False
        self._attach(body)
        return True

    def _descend_to(self, start: Vector, rotation: Matrix) -> None:
        """Move above the start of an approach, and simulate the descent to it.

        Args:
            start: position of the tool point at the start of the approach, metres.
            rotation: of the tool.
        """
        high = (*start[:2], max(self.limits.transit_height_m, start[2]))
        joints = self._solve_joints(high, rotation)
        if joints is None:
            high, joints = start, self._solve_joints(start, rotation)
        if self.teleport:
            self._teleport(joints)
        else:
            self.motion.move_joints(joints, self.held)
        self.motion.move_straight(high, start, rotation, self.held)

    def _return_home(self, *, simulate: bool) -> None:
        """Move the arm to its home configuration.

        Args:
            simulate: simulate the motion instead of teleporting the arm.
        """
        if not simulate:
            self._teleport(self.robot.home_joints)
            return
        tool = self.robot.tool_frame()
        high = (*tool.position[:2], self.limits.transit_height_m)
        if tool.position[2] < high[2]:
            rotation = quaternion_matrix(tool.orientation)
            self.motion.move_straight(tool.position, high, rotation, self.held)
        self.motion.move_joints(self.robot.home_joints, self.held)
        self.update_grasp()

    # -- contacts ----------------------------------------------------------------------------

    def _is_in_contact(self) -> bool:
        self.world.detect_collisions()
        return is_any_within(self.motion.outer_contacts(self.held), self.limits.contact_margin_m)

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
