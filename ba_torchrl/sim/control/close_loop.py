"""Close-loop motion of a top-down gripper: bounded, guarded, and simulated only where it matters.

Nothing here loops until something converges: every move has a step count that is known when it
starts. Three regimes, chosen by contact and not by task:

- nothing held and the way free: the arm is teleported along the free part of its path, which is
  sampled every centimetre (`fast_mode`; otherwise this part is simulated as well);
- nothing held and something near: the rest of the path at a bounded speed with a constant
  deceleration below the floor's friction, so that a pushed body stays at the finger;
- something held: a smooth quintic profile that the grasp's friction can follow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ba_torchrl.actions import wrap_angle
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.contacts import Contact, lateral_force_n, outer_contacts, vertical_force_n
from ba_torchrl.sim.geometry import Vector, YawPose, downward
from ba_torchrl.sim.robots.base import Robot

OPENING_TOLERANCE = 0.02
"""An opening this close to the wanted one is reached."""
STALL_FRACTION = 0.1
"""Fingers slower than this share of their speed have met something."""


@dataclass(frozen=True)
class MotionLimits:
    """Speeds and forces of close-loop motion."""

    contact_speed_m_s: float = 0.4
    contact_speed_rad_s: float = 6.0
    deceleration_m_s2: float = 4.0
    """Less than the floor's friction times gravity, or a pushed body runs ahead."""
    held_time_s: float = 0.1
    """Time for 5 cm with a body in hand; scales with the root of the distance."""
    max_vertical_force_n: float = 40.0
    """A move stops when the hand or what it holds presses harder than this along z."""
    max_lateral_force_n: float = 150.0
    """The same for forces from the side."""
    press_stride_m: float = 5e-4
    """Stride of a move that starts out pressing on something."""
    max_press_steps: int = 8
    path_sample_m: float = 0.01
    path_sample_rad: float = 0.14
    max_gripper_steps: int = 60


class CloseLoopController:
    """Moves a robot's tool and works its gripper.

    Args:
        robot: the robot, pointing down.
        teleport: skip the simulation of free travel.
        limits: speeds and forces.
    """

    def __init__(
        self, robot: Robot, *, teleport: bool = True, limits: MotionLimits | None = None
    ) -> None:
        self.robot = robot
        self.world = robot.world
        self.teleport = teleport
        self.limits = limits or MotionLimits()
        self._target_opening = 1.0

    def reset(self, pose: YawPose, opening: float = 1.0) -> None:
        """Put the tool at a pose without moving anything else.

        Raises:
            ValueError: the pose is out of reach.
        """
        joints = self.robot.inverse_kinematics(pose[0], downward(pose[1]))
        if joints is None:
            raise ValueError(f"{pose[0]} m is out of the robot's reach")
        self.robot.teleport(joints)
        self.robot.set_opening(opening)
        self._target_opening = opening

    def get_state(self) -> float:
        """Return the wanted opening, which the next `grip` is compared with."""
        return self._target_opening

    def set_state(self, state: float) -> None:
        """Take up what `get_state` returned."""
        self._target_opening = state

    def move_to(self, position: Vector, yaw_rad: float) -> None:
        """Move the tool in a straight line towards a pose, as far as reach and contacts allow."""
        robot, limits = self.robot, self.limits
        self._unwind_wrist()
        path = _Path(robot, robot.tool_pose(), (position, yaw_rad))
        held = robot.held_body()
        if held is not None:
            fraction = max(path.length_m / 0.05, 0.6 * path.angle_rad / (math.pi / 4), 0.15)
            duration = limits.held_time_s * math.sqrt(fraction)
            count = max(4, round(duration / self.world.physics.time_step_s))
            self._simulate_path(
                path, [quintic_time_scaling(i / count) for i in range(1, count + 1)], held
            )
        else:
            done = self._teleport_free_part(path) if self.teleport else 0.0
            if done == 0.0 and path.goes_down and self._is_in_contact_below(held):
                done = self._press_down(path)
            if done < 1.0:
                rest = [done + (1 - done) * u for u in self._contact_profile(path, 1 - done)]
                self._simulate_path(path, rest, None)
        self.world.step()

    def grip(self, opening: float) -> None:
        """Open or close the fingers towards an opening until they are there or meet something."""
        if abs(opening - self._target_opening) < 1e-3:
            return
        self._target_opening = opening
        move_fingers(self.robot, opening, self.limits.max_gripper_steps)

    # ----------------------------------------------------------------------------------------

    def _unwind_wrist(self) -> None:
        """Turn the last joint back by whole turns, which moves nothing, before it hits a limit."""
        turns = round(self.robot.joints[-1] / (2 * math.pi))
        if turns:
            joints = self.robot.measured_joints()
            joints[-1] -= turns * 2 * math.pi
            self.robot.teleport(joints)

    def _teleport_free_part(self, path: _Path) -> float:
        """Teleport along the path to the last sample that touches nothing; return its place."""
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
            self.robot.teleport(joints)
            if self.robot.is_near_anything():
                break
            free, done = joints, i / count
        self.robot.teleport(free)
        return done

    def _press_down(self, path: _Path) -> float:
        """Press from where the hand rests, a fraction of a millimetre at a time.

        Returns:
            The place reached; 1 if the press is firm, which ends the move.
        """
        stride = self.limits.press_stride_m / max(path.length_m, self.limits.press_stride_m)
        place = 0.0
        for _ in range(self.limits.max_press_steps):
            place = min(place + stride, 1.0)
            if not self._simulate_path(path, [place], None):
                return 1.0
        return place

    def _is_in_contact_below(self, held: Body | None) -> bool:
        """Whether the hand, or what it holds, stands on anything else or all but touches it."""
        return any(
            point.is_vertical and point.distance_m < 2 * self.limits.press_stride_m
            for point in self._outer_contacts(held)
        )

    def _contact_profile(self, path: _Path, share: float) -> list[float]:
        """Return the places along the last ``share`` of the path, one per step, from 0 to 1."""
        limits, dt = self.limits, self.world.physics.time_step_s
        length = path.length_m * share
        speed = min(
            limits.contact_speed_m_s, math.sqrt(2 * limits.deceleration_m_s2 * max(length, 1e-6))
        )
        braking = speed / limits.deceleration_m_s2
        cruising = max(length - 0.5 * speed * braking, 0.0) / speed
        duration = max(
            cruising + braking, path.angle_rad * share / limits.contact_speed_rad_s, 2 * dt
        )
        count = max(2, math.ceil(duration / dt))
        brake = min(1.0, braking / duration)  # share of the time
        total = 1 - brake / 2

        def place(u: float) -> float:
            covered = u if u <= 1 - brake else total - (1 - u) ** 2 / (2 * brake)
            return covered / total

        return [place(i / count) for i in range(1, count + 1)]

    def _simulate_path(self, path: _Path, places: list[float], held: Body | None) -> bool:
        """Simulate the path; stop where it leaves the reach, step back where it presses.

        Returns:
            Whether it went all the way.
        """
        robot = self.robot
        arrived = True
        for place in places:
            joints = path.joints_at(place)
            if joints is None:
                arrived = False
                break
            before = robot.joints
            robot.command(joints)
            self.world.step()
            if self._is_overloaded(held):
                # a stiff arm left where it is would press the body deeper with every try
                robot.command(before)
                self.world.step()
                arrived = False
                break
        measured = robot.measured_joints()
        if max(abs(a - b) for a, b in zip(measured, robot.joints, strict=True)) > 5e-3:
            robot.command(measured)  # do not go on pushing against what stopped it
        return arrived

    def _is_overloaded(self, held: Body | None) -> bool:
        """Whether the hand, or what it holds, presses too hard on anything else."""
        points = self._outer_contacts(held)
        return (
            vertical_force_n(points) > self.limits.max_vertical_force_n
            or lateral_force_n(points) > self.limits.max_lateral_force_n
        )

    def _outer_contacts(self, held: Body | None) -> list[Contact]:
        """Return the contacts of the hand and the held body with everything else."""
        inner = () if held is None else (held.id,)
        return outer_contacts(self.world.client, self.robot.id, *inner)


class _Path:
    """A straight line of the tool with a steady turn, in joint angles."""

    def __init__(self, robot: Robot, start: YawPose, end: YawPose) -> None:
        self._robot = robot
        self._start, self._start_yaw = start
        self._delta = tuple(e - s for s, e in zip(self._start, end[0], strict=True))
        self._turn = wrap_angle(end[1] - start[1])
        self.length_m = math.hypot(*self._delta)
        self.goes_down = self._delta[2] < -1e-4
        self.angle_rad = abs(self._turn)

    def joints_at(self, place: float) -> list[float] | None:
        """Return the joints at a place between 0 and 1, or None out of reach."""
        x, y, z = (s + place * d for s, d in zip(self._start, self._delta, strict=True))
        rotation = downward(self._start_yaw + place * self._turn)
        return self._robot.inverse_kinematics((x, y, z), rotation, self._robot.joints)


def quintic_time_scaling(u: float) -> float:
    """Return a smooth way from 0 to 1: zero velocity and acceleration at both ends."""
    return u * u * u * (10 - 15 * u + 6 * u * u)


def move_fingers(robot: Robot, opening: float, max_steps: int) -> None:
    """Move the fingers at their speed until they are there or meet something.

    Args:
        robot: whose fingers; the simulation goes on meanwhile.
        opening: where to, 0 to 1.
        max_steps: they are left on their way after so many steps.
    """
    stride = robot.finger_speed * robot.world.physics.time_step_s / robot.finger_open_position
    target = robot.opening()
    resting = 0
    for _ in range(max_steps):
        before = robot.opening()
        target += min(max(opening - target, -stride), stride)
        robot.command_opening(target)
        robot.world.step()
        after = robot.opening()
        if target == opening and abs(after - opening) < OPENING_TOLERANCE:
            return
        resting = resting + 1 if abs(after - before) < STALL_FRACTION * stride else 0
        if resting >= 2:
            break
    robot.command_opening(opening)  # the motors stay on: they squeeze what the fingers met
