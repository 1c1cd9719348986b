"""Franka Emika Panda with the Franka hand: model and closed-form inverse kinematics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import pybullet
import pybullet_data

from ba_torchrl.sim.geometry import Matrix, Vector, cross, dot, perpendicular
from ba_torchrl.sim.robots.base import ROBOTS, Robot
from ba_torchrl.sim.world import loading

_SHOULDER_HEIGHT_M = 0.333
_UPPER_ARM_M = 0.316
_FOREARM_M = 0.384
_ELBOW_OFFSET_M = 0.0825
_WRIST_OFFSET_M = 0.088
_FLANGE_M = 0.107
_TOOL_M = 0.1035
"""Distance from the flange to the tool point; that to the fingertips is 0.1122 m."""
_BASE_M = (-0.05, 0.0, 0.0)

_SHOULDER_TO_ELBOW_M = math.hypot(_UPPER_ARM_M, _ELBOW_OFFSET_M)
_ELBOW_TO_WRIST_M = math.hypot(_FOREARM_M, _ELBOW_OFFSET_M)
_SHOULDER_OFFSET_RAD = math.atan2(_ELBOW_OFFSET_M, _UPPER_ARM_M)
_WRIST_OFFSET_RAD = math.atan2(_ELBOW_OFFSET_M, _FOREARM_M)
_HAND_ANGLE_RAD = math.pi / 4
"""Angle of the closing axis about the axis of joint 7."""

_SWIVEL_ITERATIONS = 6
_SWIVEL_DIFFERENCE_RAD = 1e-4
_SWIVEL_DAMPING = 0.04
_SWIVEL_LIMIT_RAD = 0.6
_TOLERANCE = 1e-10


@ROBOTS.register("panda")
class Panda(Robot):
    """Franka Emika Panda, a seven-joint arm with the Franka hand (paper section 3.4).

    The model is `franka_panda/panda.urdf` of PyBullet's data package.
    """

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

    model_file: ClassVar[str] = f"{pybullet_data.getDataPath()}/franka_panda/panda.urdf"
    """URDF model of arm and hand; another has the same joints and links."""
    finger_force = 10.0
    finger_speed = 0.4

    def load(self) -> int:
        with loading(self.model_file):
            return pybullet.loadURDF(
                self.model_file, _BASE_M, useFixedBase=True, physicsClientId=self.client
            )

    def inverse_kinematics(
        self, position: Vector, rotation: Matrix, near: Sequence[float] | None = None
    ) -> list[float] | None:
        """Return the arm joints for a pose of the tool; see `Robot.inverse_kinematics`.

        The arm is redundant. For a given swivel angle, by which the wrist offset is rotated about
        the approach direction, the solution is in closed form. A few Gauss-Newton iterations find
        the swivel angle at which the upper arm is in the vertical plane through the wrist; the
        damping keeps the angle near zero where it hardly affects the elbow. If the tool points
        straight down, the angle is zero without iterations.
        """
        finger, _, approach = zip(*rotation, strict=True)
        tool_distance = _FLANGE_M + _TOOL_M
        x, y, z = (
            p - tool_distance * a - b for p, a, b in zip(position, approach, _BASE_M, strict=True)
        )
        center = (x, y, z - _SHOULDER_HEIGHT_M)
        radius = math.hypot(x, y) or 1.0
        outwards = (x / radius, y / radius, 0.0)
        sideways = (-outwards[1], outwards[0], 0.0)
        start = perpendicular(outwards, approach)
        across = cross(approach, start)

        def solve(parameter: float) -> _ArmConfiguration | None:
            swivel = _SWIVEL_LIMIT_RAD * math.tanh(parameter / _SWIVEL_LIMIT_RAD)
            cos, sin = math.cos(swivel), math.sin(swivel)
            offset = tuple(cos * s + sin * a for s, a in zip(start, across, strict=True))
            return _solve_arm(center, approach, offset)

        parameter = 0.0
        arm = solve(parameter)
        if arm is None:
            return None
        # a fixed number of damped iterations: the solution is continuous even if not converged
        for _ in range(_SWIVEL_ITERATIONS):
            residual = dot(arm.upper_arm, sideways)
            if abs(residual) < _TOLERANCE:
                break
            shifted = solve(parameter + _SWIVEL_DIFFERENCE_RAD)
            if shifted is None:
                break
            slope = (dot(shifted.upper_arm, sideways) - residual) / _SWIVEL_DIFFERENCE_RAD
            parameter -= residual * slope / (slope * slope + _SWIVEL_DAMPING)
            updated = solve(parameter)
            if updated is None:
                break
            arm = updated
        return self._joint_angles(arm, outwards, finger, approach, near)

    def _joint_angles(
        self,
        arm: _ArmConfiguration,
        outwards: Vector,
        finger: Vector,
        approach: Vector,
        near: Sequence[float] | None,
    ) -> list[float]:
        """Return the joint angles for the directions of the links.

        ``outwards`` is the horizontal direction from the base to the wrist.
        """
        ux, uy, uz = arm.upper_arm
        horizontal = math.hypot(ux, uy)
        # an upper arm that leans backwards is a negative joint 2, not a base rotated by half a
        # turn; near the border between the two cases, the reference joints decide
        forward = outwards
        if near is not None:
            forward = (forward[0] + math.cos(near[0]), forward[1] + math.sin(near[0]), 0.0)
        sign = 1.0 if dot(arm.upper_arm, forward) >= 0 else -1.0
        if horizontal > 1e-7:
            c1, s1 = sign * ux / horizontal, sign * uy / horizontal
        else:
            c1, s1 = outwards[0], outwards[1]
        q2 = math.atan2(sign * horizontal, uz)
        c2, s2 = math.cos(q2), math.sin(q2)
        elbow_axis = cross(arm.forearm_normal, arm.forearm)  # of joint 4
        upper_front = cross(arm.upper_arm, elbow_axis)
        q3 = math.atan2(dot(upper_front, (-s1, c1, 0.0)), dot(upper_front, (c1 * c2, s1 * c2, -s2)))
        across = cross(approach, arm.offset)  # axis of joint 6
        q5 = math.atan2(dot(across, arm.forearm_normal), dot(across, elbow_axis))
        q7 = math.atan2(dot(finger, across), dot(finger, arm.offset)) - _HAND_ANGLE_RAD
        joints = [math.atan2(s1, c1), q2, q3, arm.elbow_rad, q5, arm.wrist_rad, q7]
        if near is not None:
            full = 2 * math.pi
            joints = [q + full * round((n - q) / full) for q, n in zip(joints, near, strict=True)]
        return joints


class _ArmConfiguration(NamedTuple):
    """Directions of the links, and the angles of joints 4 and 6."""

    upper_arm: Vector
    forearm: Vector
    forearm_normal: Vector
    """Perpendicular to the forearm, towards the inside of the elbow."""
    offset: Vector
    """Direction from the axis of joint 6 to that of joint 7."""
    elbow_rad: float
    """Angle of joint 4."""
    wrist_rad: float
    """Angle of joint 6."""


def _solve_arm(center: Vector, approach: Vector, offset: Vector) -> _ArmConfiguration | None:
    """Return the arm configuration for a direction of joint 7 and of the wrist offset.

    It is None if the point on the axis of joint 7, relative to the shoulder, is out of reach. The
    offset points from the axis of joint 6 to that of joint 7.
    """
    wrist = tuple(c - _WRIST_OFFSET_M * o for c, o in zip(center, offset, strict=True))
    distance = math.sqrt(dot(wrist, wrist))
    cos_elbow = (_SHOULDER_TO_ELBOW_M**2 + _ELBOW_TO_WRIST_M**2 - distance**2) / (
        2 * _SHOULDER_TO_ELBOW_M * _ELBOW_TO_WRIST_M
    )
    if abs(cos_elbow) > 1:
        return None
    elbow_rad = math.acos(cos_elbow) - _SHOULDER_OFFSET_RAD - _WRIST_OFFSET_RAD - math.pi
    # angle between the forearm, which is perpendicular to joint 6, and the line wrist - shoulder
    slant = _WRIST_OFFSET_RAD + math.acos(
        min(
            (distance**2 + _ELBOW_TO_WRIST_M**2 - _SHOULDER_TO_ELBOW_M**2)
            / (2 * distance * _ELBOW_TO_WRIST_M),
            1.0,
        )
    )
    to_shoulder = tuple(-w / distance for w in wrist)
    along, down = dot(to_shoulder, offset), dot(to_shoulder, approach)
    cos_remaining = math.cos(slant) / max(math.hypot(along, down), 1e-9)
    if abs(cos_remaining) > 1:
        return None
    wrist_rad = math.acos(cos_remaining) + math.pi - math.atan2(-along, -down)
    c6, s6 = math.cos(wrist_rad), math.sin(wrist_rad)
    forearm = tuple(s6 * o - c6 * a for o, a in zip(offset, approach, strict=True))
    front = perpendicular(to_shoulder, forearm)
    elbow = tuple(
        w - _FOREARM_M * f + _ELBOW_OFFSET_M * n
        for w, f, n in zip(wrist, forearm, front, strict=True)
    )
    perpendicular_to_elbow = cross(cross(front, forearm), elbow)
    upper_arm = tuple(
        (_UPPER_ARM_M * e + _ELBOW_OFFSET_M * t) / _SHOULDER_TO_ELBOW_M**2
        for e, t in zip(elbow, perpendicular_to_elbow, strict=True)
    )
    return _ArmConfiguration(upper_arm, forearm, front, offset, elbow_rad, wrist_rad)
