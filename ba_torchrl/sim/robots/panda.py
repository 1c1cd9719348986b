"""Franka Emika Panda with its own two-finger hand: closed-form inverse kinematics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import pybullet
import pybullet_data

from ba_torchrl.sim.geometry import Matrix, Vector, cross, dot, perpendicular
from ba_torchrl.sim.robots.base import ROBOTS, Robot

_SHOULDER_HEIGHT_M = 0.333
_UPPER_ARM_M = 0.316
_FOREARM_M = 0.384
_ELBOW_OFFSET_M = 0.0825
_WRIST_OFFSET_M = 0.088
_FLANGE_M = 0.107
_TOOL_M = 0.1035
"""From the flange to the tool point; the fingertips end at 0.1122 m."""
_BASE_M = (-0.05, 0.0, 0.0)

_SHOULDER_TO_ELBOW_M = math.hypot(_UPPER_ARM_M, _ELBOW_OFFSET_M)
_ELBOW_TO_WRIST_M = math.hypot(_FOREARM_M, _ELBOW_OFFSET_M)
_SHOULDER_OFFSET_RAD = math.atan2(_ELBOW_OFFSET_M, _UPPER_ARM_M)
_WRIST_OFFSET_RAD = math.atan2(_ELBOW_OFFSET_M, _FOREARM_M)
_HAND_ANGLE_RAD = math.pi / 4
"""Angle of the fingers' line about the axis of joint 7."""

_SWIVEL_ITERATIONS = 6
_SWIVEL_DIFFERENCE_RAD = 1e-4
_SWIVEL_DAMPING = 0.04
_SWIVEL_LIMIT_RAD = 0.6
_TOLERANCE = 1e-10


@ROBOTS.register("panda")
class Panda(Robot):
    """Seven-joint arm on a base behind the workspace (paper section 3.4)."""

    arm_joints = tuple(range(7))
    finger_joints = (9, 10)
    finger_open_signs = (1.0, 1.0)
    finger_open_position = 0.04
    finger_links = (frozenset({9}), frozenset({10}))
    grasp_normal_signs = (1.0, -1.0)
    non_colliding_links = (*range(-1, 8), 11)
    hand_link = 8
    tool_offset_m = (0.0, 0.0, _TOOL_M)
    tool_orientation = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))  # the fingers open along y
    home_joints = (1.212, -0.42, 0.0, -2.188, 0.0, 1.768, 0.427)
    camera_height_m = 0.04
    finger_span_m = 42 * 0.3 / 128
    hand_half_extents_m = (0.105, 0.035)

    finger_force = 10.0
    finger_speed = 0.4

    def load(self) -> int:
        """Load the arm, its gear between the fingers, and widen its joint limits."""
        robot = pybullet.loadURDF(
            f"{pybullet_data.getDataPath()}/franka_panda/panda.urdf",
            _BASE_M,
            useFixedBase=True,
            physicsClientId=self.client,
        )
        self._widen_joint_limits(robot)
        # two force-limited fingers have no stiffness along their common axis: held bodies slide
        self._add_gear(robot, *self.finger_joints, ratio=-1)
        return robot

    def inverse_kinematics(
        self, position: Vector, rotation: Matrix, near: Sequence[float] | None = None
    ) -> list[float] | None:
        """Solve in closed form for a given swivel of the hand about its approach.

        The arm has a joint to spare. The swivel that is chosen turns the first joint towards the
        hand, so that the upper arm may pass through the vertical. Where the forearm points along
        the approach the swivel hardly moves the elbow: there it stays as it is, the wrist's offset
        pointing outwards. Pointing down, both are the same and nothing is left to search for.
        """
        finger, _, approach = zip(*rotation, strict=True)
        reach = _FLANGE_M + _TOOL_M
        x, y, z = (p - reach * a - b for p, a, b in zip(position, approach, _BASE_M, strict=True))
        center = (x, y, z - _SHOULDER_HEIGHT_M)
        radius = math.hypot(x, y) or 1.0
        outwards = (x / radius, y / radius, 0.0)
        beside = (-outwards[1], outwards[0], 0.0)
        start = perpendicular(outwards, approach)
        across = cross(approach, start)

        def solve(turn: float) -> _ArmConfiguration | None:
            swivel = _SWIVEL_LIMIT_RAD * math.tanh(turn / _SWIVEL_LIMIT_RAD)
            cos, sin = math.cos(swivel), math.sin(swivel)
            offset = tuple(cos * s + sin * a for s, a in zip(start, across, strict=True))
            return _solve_arm(center, approach, offset)

        turn = 0.0
        arm = solve(turn)
        if arm is None:
            return None
        # damped Gauss-Newton, a fixed number of rounds: smooth in the pose, converged or not
        for _ in range(_SWIVEL_ITERATIONS):
            lean = dot(arm.upper_arm, beside)
            if abs(lean) < _TOLERANCE:
                break
            ahead = solve(turn + _SWIVEL_DIFFERENCE_RAD)
            if ahead is None:
                break
            slope = (dot(ahead.upper_arm, beside) - lean) / _SWIVEL_DIFFERENCE_RAD
            turn -= lean * slope / (slope * slope + _SWIVEL_DAMPING)
            moved = solve(turn)
            if moved is None:
                break
            arm = moved
        return self._joints(arm, outwards, finger, approach, near)

    def _joints(
        self,
        arm: _ArmConfiguration,
        outwards: Vector,
        finger: Vector,
        approach: Vector,
        near: Sequence[float] | None,
    ) -> list[float]:
        """Read the joint angles off the directions of the links."""
        ux, uy, uz = arm.upper_arm
        level = math.hypot(ux, uy)
        # leaning back is a negative second joint, not a base turned round; leaning sideways,
        # either will do, but not one after the other
        ahead = outwards
        if near is not None:
            ahead = (ahead[0] + math.cos(near[0]), ahead[1] + math.sin(near[0]), 0.0)
        sign = 1.0 if dot(arm.upper_arm, ahead) >= 0 else -1.0
        if level > 1e-7:
            c1, s1 = sign * ux / level, sign * uy / level
        else:
            c1, s1 = outwards[0], outwards[1]
        q2 = math.atan2(sign * level, uz)
        c2, s2 = math.cos(q2), math.sin(q2)
        elbow_axis = cross(arm.forearm_normal, arm.forearm)  # of joint 4
        upper_front = cross(arm.upper_arm, elbow_axis)
        q3 = math.atan2(dot(upper_front, (-s1, c1, 0.0)), dot(upper_front, (c1 * c2, s1 * c2, -s2)))
        across = cross(approach, arm.offset)  # axis of joint 6
        q5 = math.atan2(dot(across, arm.forearm_normal), dot(across, elbow_axis))
        q7 = math.atan2(dot(finger, across), dot(finger, arm.offset)) - _HAND_ANGLE_RAD
        joints = [math.atan2(s1, c1), q2, q3, arm.elbow_rad, q5, arm.wrist, q7]
        if near is not None:
            full = 2 * math.pi
            joints = [q + full * round((n - q) / full) for q, n in zip(joints, near, strict=True)]
        return joints


class _ArmConfiguration(NamedTuple):
    """Directions of the links, and the two angles that follow from lengths alone."""

    upper_arm: Vector
    forearm: Vector
    forearm_normal: Vector
    """Of the forearm, perpendicular to it, to the inside of the elbow."""
    offset: Vector
    """From the axis of joint 6 to that of joint 7."""
    elbow_rad: float
    wrist: float


def _solve_arm(center: Vector, approach: Vector, offset: Vector) -> _ArmConfiguration | None:
    """Solve the arm that ends at a point of the axis of joint 7, given the wrist's offset.

    Args:
        center: the point on the axis of joint 7, seen from the shoulder, in metres.
        approach: direction of that axis.
        offset: direction of the wrist's offset.
    """
    wrist = tuple(c - _WRIST_OFFSET_M * o for c, o in zip(center, offset, strict=True))
    distance = math.sqrt(dot(wrist, wrist))
    cos_elbow = (_SHOULDER_TO_ELBOW_M**2 + _ELBOW_TO_WRIST_M**2 - distance**2) / (
        2 * _SHOULDER_TO_ELBOW_M * _ELBOW_TO_WRIST_M
    )
    if abs(cos_elbow) > 1:
        return None
    elbow_rad = math.acos(cos_elbow) - _SHOULDER_OFFSET_RAD - _WRIST_OFFSET_RAD - math.pi
    # angle of the forearm with the line from wrist to shoulder; it is perpendicular to joint 6
    slant = _WRIST_OFFSET_RAD + math.acos(
        min(
            (distance**2 + _ELBOW_TO_WRIST_M**2 - _SHOULDER_TO_ELBOW_M**2)
            / (2 * distance * _ELBOW_TO_WRIST_M),
            1.0,
        )
    )
    back = tuple(-w / distance for w in wrist)
    along, down = dot(back, offset), dot(back, approach)
    cos_rest = math.cos(slant) / max(math.hypot(along, down), 1e-9)
    if abs(cos_rest) > 1:
        return None
    angle = math.acos(cos_rest) + math.pi - math.atan2(-along, -down)
    c6, s6 = math.cos(angle), math.sin(angle)
    forearm = tuple(s6 * o - c6 * a for o, a in zip(offset, approach, strict=True))
    front = perpendicular(back, forearm)
    elbow = tuple(
        w - _FOREARM_M * f + _ELBOW_OFFSET_M * n
        for w, f, n in zip(wrist, forearm, front, strict=True)
    )
    turned = cross(cross(front, forearm), elbow)
    upper_arm = tuple(
        (_UPPER_ARM_M * e + _ELBOW_OFFSET_M * t) / _SHOULDER_TO_ELBOW_M**2
        for e, t in zip(elbow, turned, strict=True)
    )
    return _ArmConfiguration(upper_arm, forearm, front, offset, elbow_rad, angle)
