"""Close-loop control of a tool that points straight down.

The number of physics steps of a motion is bounded. There are three cases:

- Nothing is held, and the path is free: the arm is teleported along the free part of the path,
  which is checked at samples (with `fast_mode`; otherwise this part is simulated, too).
- Nothing is held, and something is near: the rest of the path is simulated at a bounded speed. The
  deceleration is less than the floor's friction causes, so that a pushed body stays at the finger.
- A body is held: the path is simulated with quintic time scaling, whose acceleration the friction
  of the grasp can transmit. With `fast_mode`, a body that did not slip in such a motion, and that
  nothing but the gripper supported at its end, is teleported with the arm along the free part of
  the next paths until it slips, while all other bodies are at rest and do not touch it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

from ba_torchrl.core.actions import wrap_angle
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.contacts import (
    Contact,
    contacts,
    is_any_within,
    lateral_direction,
    lateral_force_n,
    outer_contacts,
    vertical_direction,
    vertical_force_n,
)
from ba_torchrl.sim.geometry import Pose, Vector, YawPose, bullet_compose, bullet_inverse, downward
from ba_torchrl.sim.robots.base import DISTANT_M, Robot

OPENING_TOLERANCE = 0.02
"""Tolerance within which a target opening counts as reached."""
STALL_FRACTION = 0.1
"""Fingers that move at less than this fraction of their commanded speed are in contact."""
MAX_OVERSPEED = 1.5
"""Fingers that move at more than this multiple of their commanded speed swing."""


@dataclass(frozen=True)
class MotionLimits:
    """Limits of close-loop control."""

    contact_speed_m_s: float = 0.4
    """Maximum speed where contacts are possible and nothing is held."""
    contact_speed_rad_s: float = 6.0
    deceleration_m_s2: float = 4.0
    """Less than the floor's friction times gravity: otherwise a pushed body slides ahead."""
    held_time_s: float = 0.1
    """Duration of a displacement of 5 cm with a held body; it is proportional to the square root of
    the displacement."""
    max_vertical_force_n: float = 40.0
    """The tool yields when the sum of the vertical contact forces of the hand and the held body
    exceeds this."""
    max_lateral_force_n: float = 150.0
    """The same for the lateral contact forces."""
    yield_m: float = 1e-3
    """Displacement of a tool that yields."""
    press_stride_m: float = 5e-4
    """Displacement per step of a downward motion that starts in contact."""
    max_press_steps: int = 8
    path_sample_m: float = 0.01
    """Distance between the samples at which a path is checked for contacts."""
    path_sample_rad: float = 0.14
    path_margin_m: float = 1e-3
    """Distance of a contact point below which a sample is not free. Bullet has contact points of
    two boxes when they touch, and of other shapes from a distance of up to 0.8 mm."""
    max_slip_m: float = 5e-4
    """Displacement of a held body in the tool frame, perpendicular to the closing axis, above which
    it has slipped: in one simulated motion, or since then in all teleports. A cube has up to 0.2 mm
    in its first lift."""
    max_turn_rad: float = 0.02
    """The same for the rotation of a held body in the tool frame."""
    max_fall_fraction: float = 0.25
    """Displacement of a held body in the step after a teleport above which it slips, as a fraction
    of a falling body's."""
    max_regrasp_steps: int = 4
    """Maximum number of further physics steps in which a teleported body comes to rest in the
    gripper."""
    max_gripper_steps: int = 60
    """Maximum number of physics steps for opening or closing the gripper."""


class CloseLoopController:
    """Moves a tool that points straight down, and opens and closes the gripper.

    Args:
        teleport: teleport the arm, and a firmly held body, along the free part of a path instead of
            simulating it.
    """

    def __init__(self, robot: Robot, *, teleport: bool = True) -> None:
        self.robot = robot
        self.world = robot.world
        self.teleport = teleport
        self.limits = MotionLimits()
        self._target_opening = 1.0
        self._grasp: FirmGrasp | None = None
        """The grasp that a simulated motion has tested, until the body slips."""
        self.is_out_of_reach = False
        """Whether the last motion ended where its path left the reach of the arm."""

    def reset(self, pose: YawPose, opening: float = 1.0) -> None:
        """Teleport the tool to a pose, without simulation."""
        joints = self.robot.inverse_kinematics(pose[0], downward(pose[1]))
        if joints is None:
            raise ValueError(f"{pose[0]} m is out of the robot's reach")
        self.robot.teleport(joints)
        self.robot.set_opening(opening)
        self._target_opening = opening
        self._grasp = None

    def get_state(self) -> tuple[float, int | None, Pose | None]:
        """Return the target opening of `grip`, and index and pose of the body of `FirmGrasp`."""
        body, pose = self._grasp or (None, None)
        return self._target_opening, None if body is None else self.world.bodies.index(body), pose

    def set_state(self, state: tuple[float, int | None, Pose | None]) -> None:
        """Restore the state of `get_state`, of a world with the same bodies."""
        self._target_opening, index, pose = state
        self._grasp = None if index is None else FirmGrasp(self.world.bodies[index], pose)

    def move_to(self, position: Vector, yaw_rad: float) -> None:
        """Move the tool along a straight line to a pose.

        The motion ends early where the pose is out of reach. Where a contact force exceeds its
        limit, the tool yields by a small distance and continues without the motion against the
        force: it slides along surfaces.
        """
        self.is_out_of_reach = False
        self._unwind_wrist()
        path = Path(self.robot, self.robot.tool_pose(), (position, yaw_rad))
        held = self.robot.held_body()
        if held is None:
            self._move_empty(path)
        else:
            self._move_held(path, held)

    def grip(self, opening: float) -> None:
        """Open or close the fingers until they reach an opening or are stopped by a contact.

        Fingers that have this opening as their target are moved only if they swing, as they do
        when the body that they pressed on has slipped out.
        """
        were_swinging = stop_swing(self.robot, self.limits.max_gripper_steps)
        if abs(opening - self._target_opening) < 1e-3 and not were_swinging:
            return
        self._target_opening = opening
        move_fingers(self.robot, opening, self.limits.max_gripper_steps)
        if self._grasp is not None and self.robot.held_body() is not self._grasp.body:
            self._grasp = None

    # ----------------------------------------------------------------------------------------

    def _move_empty(self, path: Path) -> None:
        """Move an empty gripper along the path, and simulate one step at its end."""
        self._grasp = None
        done = self._teleport_free_part(path, None) if self.teleport else 0.0
        if done == 0.0 and path.goes_down and self._is_in_contact_below():
            done = self._press_down(path)
        if done < 1.0:
            rest = [done + (1 - done) * u for u in self._contact_profile(path, 1 - done)]
            self._simulate_path(path, rest, None)
        self.world.step()

    def _move_held(self, path: Path, held: Body) -> None:
        """Move a held body along the path, and simulate at least one step at its end."""
        before = pose_in_tool_frame(self.robot, held)
        tested = self._grasp.pose if self._grasp and self._grasp.body is held else None
        done, is_steady = 0.0, True
        if self.teleport and tested is not None and self._is_undisturbed(held):
            done = self._teleport_free_part(path, held)
            is_steady = done == 0.0 or self._step_in_grasp(held, before)
        if done < 1.0:
            self._simulate_held(path, done, held)
            self.world.step()
            tested = None if self._is_supported(held) else before
        self._grasp = None
        if (
            is_steady
            and tested is not None
            and self._has_kept(tested, held, self.limits.max_slip_m)
        ):
            was_teleported = done == 1.0
            pose = tested if was_teleported else pose_in_tool_frame(self.robot, held)
            self._grasp = FirmGrasp(held, pose)

    def _simulate_held(self, path: Path, done: float, held: Body) -> None:
        """Simulate the rest of the path, after a fraction ``done``, with a held body."""
        left = 1 - done
        fraction = left * max(path.length_m / 0.05, 0.6 * path.angle_rad / (math.pi / 4))
        duration = self.limits.held_time_s * math.sqrt(max(fraction, 0.15))
        count = max(4, round(duration / self.world.physics.time_step_s))
        scaling = [quintic_time_scaling(i / count) for i in range(1, count + 1)]
        self._simulate_path(path, [done + left * u for u in scaling], held)

    def _step_in_grasp(self, held: Body, grasp: Pose) -> bool:
        """Simulate a step after a teleport of a held body, until the body rests in the gripper.

        A body that turns in this step has too few contacts with the fingers. Those at its new pose
        are added, the body is placed at its pose in the tool frame again, and another step is
        simulated. Return whether it rests after at most `max_regrasp_steps` further steps.
        """
        physics, limits = self.world.physics, self.limits
        max_slip_m = limits.max_fall_fraction * physics.gravity_m_s2 * physics.time_step_s**2
        self.world.step()
        for _ in range(limits.max_regrasp_steps):
            if self._has_kept(grasp, held, max_slip_m):
                return True
            self.world.detect_collisions()
            place_in_tool_frame(self.robot, held, grasp)
            self.world.step()
        return self._has_kept(grasp, held, max_slip_m)

    def _has_kept(self, grasp: Pose, held: Body, max_slip_m: float) -> bool:
        """Whether a held body has kept its pose in the tool frame."""
        slip_m, turn_rad = slip(grasp, pose_in_tool_frame(self.robot, held))
        return slip_m <= max_slip_m and turn_rad <= self.limits.max_turn_rad

    def _is_supported(self, held: Body) -> bool:
        """Whether a held body was in contact with another body than the robot in the last step."""
        touching = contacts(self.world.client, held.id)
        return is_any_within(point for point in touching if point.other_id != self.robot.id)

    def _is_undisturbed(self, held: Body) -> bool:
        """Whether all other bodies are at rest, and none that can move touched the hand or it."""
        movable = {body.id for body in self.world.moving_bodies}
        touching = (point for point in hand_contacts(self.robot, held) if point.other_id in movable)
        return not is_any_within(touching) and self.world.is_still(except_for=held)

    def _unwind_wrist(self) -> None:
        """Change the last joint by a multiple of 2 pi, which keeps it within its limits."""
        revolutions = round(self.robot.joints[-1] / (2 * math.pi))
        if revolutions:
            joints = self.robot.measured_joints()
            joints[-1] -= revolutions * 2 * math.pi
            self.robot.teleport(joints)

    def _teleport_free_part(self, path: Path, held: Body | None) -> float:
        """Teleport to the last sample before the first contact; return its fraction of the path.

        A held body keeps its pose in the tool frame. It and the arm stay where they are if the
        first sample is in contact.
        """
        start = self.robot.measured_joints()
        grasp = None if held is None else pose_in_tool_frame(self.robot, held)
        count = max(
            1,
            math.ceil(
                max(
                    path.length_m / self.limits.path_sample_m,
                    path.angle_rad / self.limits.path_sample_rad,
                )
            ),
        )
        free = self.robot.joints
        done = 0.0
        for i in range(1, count + 1):
            joints = path.joints_at(i / count)
            if joints is None:
                break
            self.robot.place_arm(joints)
            if held is not None:
                place_in_tool_frame(self.robot, held, grasp)
            self.world.detect_collisions()
            if is_any_within(hand_contacts(self.robot, held), self.limits.path_margin_m):
                break
            free, done = joints, i / count
        if held is not None and done == 0.0:
            self.robot.place_arm(start)
            place_in_tool_frame(self.robot, held, grasp)
            return 0.0
        self.robot.teleport(free)
        if held is not None:
            rebuild_grasp_contacts(self.robot, held, grasp)
        return done

    def _press_down(self, path: Path) -> float:
        """Start a downward motion in contact with small displacements.

        Return the fraction of the path that was reached; 1 if a force limit ended the motion.
        """
        stride = self.limits.press_stride_m / max(path.length_m, self.limits.press_stride_m)
        fraction = 0.0
        for _ in range(self.limits.max_press_steps):
            fraction = min(fraction + stride, 1.0)
            if not self._simulate_path(path, [fraction], None):
                return 1.0
            if not path.goes_down:
                break
        return fraction

    def _is_in_contact_below(self) -> bool:
        """Whether the hand has a vertical contact, or is close to one."""
        return any(
            point.is_vertical and point.distance_m < 2 * self.limits.press_stride_m
            for point in hand_contacts(self.robot, None)
        )

    def _contact_profile(self, path: Path, remaining: float) -> list[float]:
        """Return the time scaling for a constant speed followed by a constant deceleration.

        It has the covered fraction of the remaining part of the path after each physics step.
        """
        limits, dt = self.limits, self.world.physics.time_step_s
        length = path.length_m * remaining
        speed = min(
            limits.contact_speed_m_s, math.sqrt(2 * limits.deceleration_m_s2 * max(length, 1e-6))
        )
        braking_s = speed / limits.deceleration_m_s2
        cruising_s = max(length - 0.5 * speed * braking_s, 0.0) / speed
        duration_s = max(
            cruising_s + braking_s, path.angle_rad * remaining / limits.contact_speed_rad_s, 2 * dt
        )
        count = max(2, math.ceil(duration_s / dt))
        brake = min(1.0, braking_s / duration_s)  # fraction of the duration
        total = 1 - brake / 2

        def fraction(u: float) -> float:
            covered = u if u <= 1 - brake else total - (1 - u) ** 2 / (2 * brake)
            return covered / total

        return [fraction(i / count) for i in range(1, count + 1)]

    def _simulate_path(self, path: Path, fractions: list[float], held: Body | None) -> bool:
        """Simulate a motion along fractions of the path, one for each physics step.

        The motion ends where the path is out of reach. If a force limit is exceeded, the last
        displacement is reverted, and the rest of the path yields to the force: its component
        against the force is removed. If nothing remains of it, the motion ends. Return whether it
        reached the last fraction.
        """
        robot, limits = self.robot, self.limits
        vertical_n = limits.max_vertical_force_n
        if path.goes_up:  # closing fingertips may have pressed on the floor with more
            vertical_n = max(vertical_n, vertical_force_n(hand_contacts(self.robot, held)))
        has_arrived = True
        for fraction in fractions:
            joints = path.joints_at(fraction)
            if joints is None:
                self.is_out_of_reach, has_arrived = True, False
                break
            before = robot.joints
            robot.command(joints)
            self.world.step()
            points = hand_contacts(self.robot, held)
            yields_vertically = vertical_force_n(points) > vertical_n
            yields_laterally = lateral_force_n(points) > limits.max_lateral_force_n
            if yields_vertically or yields_laterally:
                # without this, repeated actions would move the stiff arm deeper into the body
                robot.command(before)
                self.world.step()
                away = lateral_direction(points) if yields_laterally else (0.0, 0.0)
                up = vertical_direction(points) if yields_vertically else 0.0
                path.yield_to((*away, up), fraction, limits.yield_m)
                if path.remaining_m(fraction) < limits.yield_m:
                    has_arrived = False
                    break
        measured = robot.measured_joints()
        if max(abs(a - b) for a, b in zip(measured, robot.joints, strict=True)) > 5e-3:
            robot.command(measured)  # ends the force against the body that stopped the arm
        return has_arrived


def hand_contacts(robot: Robot, held: Body | None) -> list[Contact]:
    """Return the contacts of the hand and the held body with other bodies."""
    held_ids = () if held is None else (held.id,)
    return outer_contacts(robot.client, robot.id, *held_ids)


def stop_swing(robot: Robot, max_steps: int) -> bool:
    """Brake swinging fingers, and move them back between closed and open at their usual speed.

    Fingers swing after a body that they pressed on has slipped out: the force of the motors
    accelerates them to several times their usual speed, and they move past the closed position.
    There `Robot.opening` is constant, so that `move_fingers` would take them for stopped by a
    contact. Return whether they were swinging.
    """
    stride = robot.finger_speed * robot.world.physics.time_step_s / robot.finger_open_position
    for step in range(max_steps):
        if not is_swinging(robot):
            return step > 0
        opening, _ = robot.finger_motion()
        back = min(max(opening, 0.0), 1.0) - opening
        robot.command_opening(opening + min(max(back, -stride), stride))
        robot.world.step()
    return True


def is_swinging(robot: Robot) -> bool:
    """Whether the fingers are too fast, or past the closed or open position without a contact.

    A contact can hold them there, with a wide body or the rod of a drawer's handle.
    """
    opening, rate = robot.finger_motion()
    if abs(rate) * robot.finger_open_position > MAX_OVERSPEED * robot.finger_speed:
        return True
    is_past_end = not -OPENING_TOLERANCE <= opening <= 1 + OPENING_TOLERANCE
    return is_past_end and not is_any_within(contacts(robot.client, robot.id))


def move_fingers(robot: Robot, opening: float, max_steps: int) -> None:
    """Simulate a motion of the fingers until they reach an opening or are stopped by a contact.

    The motors then keep the target, so that the fingers press on what they touch.
    """
    stride = robot.finger_speed * robot.world.physics.time_step_s / robot.finger_open_position
    target = robot.opening()
    stalled_steps = 0
    for _ in range(max_steps):
        before = robot.opening()
        target += min(max(opening - target, -stride), stride)
        robot.command_opening(target)
        robot.world.step()
        after = robot.opening()
        if target == opening and abs(after - opening) < OPENING_TOLERANCE:
            return
        stalled_steps = stalled_steps + 1 if abs(after - before) < STALL_FRACTION * stride else 0
        if stalled_steps >= 2:
            break
    robot.command_opening(opening)


TILT_RAD = 0.001
"""Angle about each axis at which a corner of a face is the deepest point in the opposite face."""
_TILTS = [
    Pose((0.0, 0.0, 0.0), (0.0, a * TILT_RAD / 2, b * TILT_RAD / 2, 1.0))
    for a, b in product((1, -1), repeat=2)
]
"""Rotations of the tool frame about the axes perpendicular to the closing axis."""


class FirmGrasp(NamedTuple):
    """A grasp in which a simulated motion did not move the body."""

    body: Body
    pose: Pose
    """Pose of the body in the tool frame at the end of that motion."""


def pose_in_tool_frame(robot: Robot, body: Body) -> Pose:
    """Return the pose of a body in the tool frame."""
    return bullet_compose(bullet_inverse(robot.tool_frame()), body.pose)


def place_in_tool_frame(robot: Robot, body: Body, pose: Pose) -> None:
    """Teleport a body to a pose in the tool frame, with zero velocity."""
    body.set_pose(*bullet_compose(robot.tool_frame(), pose))


def rebuild_grasp_contacts(robot: Robot, body: Body, pose: Pose) -> None:
    """Place a held body in the tool frame, and replace its contacts.

    Bullet does not rotate the normals of persistent contacts with the bodies, and adds at most one
    contact to a pair of shapes in each collision detection. With one contact at a corner of each
    finger, a body would turn. The contacts are therefore detected at four poses with small tilts,
    at which each corner is the deepest point.
    """
    body.set_pose((DISTANT_M,) * 3, pose.orientation)
    robot.world.detect_collisions()
    for tilt in _TILTS:
        place_in_tool_frame(robot, body, bullet_compose(tilt, pose))
        robot.world.detect_collisions()
    place_in_tool_frame(robot, body, pose)


def slip(before: Pose, after: Pose) -> tuple[float, float]:
    """Return by how much a held body has moved between the fingers.

    These are the displacement perpendicular to the closing axis, metres, and the angle of rotation.
    """
    distance_m = math.dist(before.position[1:], after.position[1:])  # x is the closing axis
    cosine = abs(sum(a * b for a, b in zip(before.orientation, after.orientation, strict=True)))
    return distance_m, 2 * math.acos(min(cosine, 1.0))


class Path:
    """A straight line of the tool point with a proportional rotation about the vertical."""

    def __init__(self, robot: Robot, start: YawPose, end: YawPose) -> None:
        self._robot = robot
        self._start, self._start_yaw = start
        self._rotation_rad = wrap_angle(end[1] - start[1])
        self.angle_rad = abs(self._rotation_rad)
        self._set_delta(tuple(e - s for s, e in zip(self._start, end[0], strict=True)))

    def _set_delta(self, delta: Vector) -> None:
        self._delta = delta
        self.length_m = math.hypot(*delta)
        self.goes_down = delta[2] < -1e-4
        self.goes_up = delta[2] > 1e-4

    def yield_to(self, direction: Vector, fraction: float, distance_m: float) -> None:
        """Displace the path after a fraction, and remove its motion against the displacement.

        The direction consists of horizontal and vertical unit vectors, or zeros.
        """
        x, y, z = self._robot.tool_pose()[0]
        dx, dy, dz = self._delta
        away_x, away_y, up = direction
        against, down = min(dx * away_x + dy * away_y, 0.0), min(dz * up, 0.0)
        delta = dx - against * away_x, dy - against * away_y, dz - down * up
        tool = x + distance_m * away_x, y + distance_m * away_y, z + distance_m * up
        self._start = tuple(t - fraction * d for t, d in zip(tool, delta, strict=True))
        self._set_delta(delta)

    def remaining_m(self, fraction: float) -> float:
        """Return the length of the rest of the path, metres."""
        return (1 - fraction) * self.length_m

    def joints_at(self, fraction: float) -> list[float] | None:
        """Return the arm joints at a fraction of the path, 0 to 1; None if out of reach."""
        x, y, z = (s + fraction * d for s, d in zip(self._start, self._delta, strict=True))
        rotation = downward(self._start_yaw + fraction * self._rotation_rad)
        return self._robot.inverse_kinematics((x, y, z), rotation, self._robot.joints)


def quintic_time_scaling(u: float) -> float:
    """Return the quintic from 0 to 1 with zero velocity and acceleration at both ends."""
    return u * u * u * (10 - 15 * u + 6 * u * u)
