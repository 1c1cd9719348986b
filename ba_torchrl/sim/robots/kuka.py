"""Kuka LBR iiwa with a two-finger gripper: model and closed-form inverse kinematics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import pybullet
import pybullet_data

from ba_torchrl.sim.geometry import Matrix, Vector, dot
from ba_torchrl.sim.robots.base import ROBOTS, Robot
from ba_torchrl.sim.world import loading

_SHOULDER_HEIGHT_M = 0.36
_UPPER_ARM_M = 0.42
_FOREARM_M = 0.40
_WRIST_TO_HAND_M = 0.125
_BASE_M = (-0.1, 0.0, -0.07)


@ROBOTS.register("kuka")
class Kuka(Robot):
    """Kuka LBR iiwa, a seven-joint arm with a two-finger gripper (paper section 3.4).

    The model is `kuka_iiwa/kuka_with_gripper2.sdf` of PyBullet's data package.
    """

    arm_joints = tuple(range(7))
    finger_joints = (8, 11)
    finger_open_signs = (-1.0, 1.0)
    finger_open_position = 0.2
    finger_links = (frozenset({8, 9, 10}), frozenset({11, 12, 13}))
    finger_gear_ratio = 1.0
    grasp_normal_signs = (-1.0, 1.0)
    non_colliding_links = tuple(range(-1, 7))
    hand_link = 7
    tool_offset_m = (0.0, 0.0218, 0.222)
    home_joints = (1.128, 0.187, 0.0, -1.146, 0.0, 1.809, -2.014)
    has_flat_pads = False
    camera_height_m = 0.12
    finger_span_m = 45 * 0.3 / 128

    model_file: ClassVar[str] = f"{pybullet_data.getDataPath()}/kuka_iiwa/kuka_with_gripper2.sdf"
    """SDF model of arm and gripper; another has the same joints and links."""
    _tip_joints = (10, 13)

    def load(self) -> int:
        """Load the model, and keep the hand and the tips of the fingers straight."""
        with loading(self.model_file):
            robot = pybullet.loadSDF(self.model_file, physicsClientId=self.client)[0]
        # PyBullet sets the pose of the centre of mass, not of the link frame
        offset = pybullet.getDynamicsInfo(robot, -1, physicsClientId=self.client)[3]
        pybullet.resetBasePositionAndOrientation(
            robot,
            [b + o for b, o in zip(_BASE_M, offset, strict=True)],
            (0, 0, 0, 1),
            physicsClientId=self.client,
        )
        for joint in (7, *self._tip_joints):
            pybullet.setJointMotorControl2(
                robot,
                joint,
                pybullet.POSITION_CONTROL,
                targetPosition=0,
                force=100,
                positionGain=1.0,
                physicsClientId=self.client,
            )
        return robot

    def set_opening(self, opening: float) -> None:
        """Set the opening of the fingers, with zero velocities, and straighten their tips."""
        self._reset_joints(self._tip_joints, (0.0, 0.0))
        super().set_opening(opening)

    def inverse_kinematics(
        self, position: Vector, rotation: Matrix, near: Sequence[float] | None = None
    ) -> list[float] | None:
        """Return the arm joints for a pose of the tool; see `Robot.inverse_kinematics`.

        Joint 3 is fixed at zero, so that the elbow is in the vertical plane through the wrist. Of
        the remaining solutions, the one with the elbow up and the wrist not flipped is returned.
        """
        _, side, approach = zip(*rotation, strict=True)
        _, tool_y, tool_z = self.tool_offset_m
        tool_distance = _WRIST_TO_HAND_M + tool_z
        x, y, z = (
            p - s * tool_y - a * tool_distance - b
            for p, s, a, b in zip(position, side, approach, _BASE_M, strict=True)
        )
        z -= _SHOULDER_HEIGHT_M
        radius = math.hypot(x, y)
        cos_elbow = (radius**2 + z**2 - _UPPER_ARM_M**2 - _FOREARM_M**2) / (
            2 * _UPPER_ARM_M * _FOREARM_M
        )
        if abs(cos_elbow) > 1:
            return None
        elbow = math.acos(cos_elbow)
        base_yaw = math.atan2(y, x)
        shoulder = math.atan2(radius, z) - math.atan2(
            _FOREARM_M * math.sin(elbow), _UPPER_ARM_M + _FOREARM_M * math.cos(elbow)
        )
        # remaining rotation of the wrist, Rz(q5) Ry(q6) Rz(q7), in the frame of the forearm
        tilt = shoulder + elbow
        ct, st = math.cos(tilt), math.sin(tilt)
        c1, s1 = math.cos(base_yaw), math.sin(base_yaw)
        forearm_x = (c1 * ct, s1 * ct, -st)
        forearm_y = (-s1, c1, 0.0)
        forearm_z = (c1 * st, s1 * st, ct)
        hand_x = tuple(row[0] for row in rotation)
        m02, m12, m22 = (dot(axis, approach) for axis in (forearm_x, forearm_y, forearm_z))
        bend = math.hypot(m02, m12)
        if bend > 1e-9:
            q5, q6, sign = math.atan2(m12, m02), math.atan2(bend, m22), 1.0
            if abs(q5) > math.pi / 2:  # take the other solution, whose wrist is not flipped
                q5, q6, sign = q5 - math.copysign(math.pi, q5), -q6, -1.0
            q7 = math.atan2(sign * dot(forearm_z, side), -sign * dot(forearm_z, hand_x))
        else:  # wrist singularity: the axes of joints 5 and 7 coincide
            q5, q6 = 0.0, math.atan2(0.0, m22)
            q7 = math.atan2(
                dot(forearm_y, hand_x), math.copysign(1.0, m22) * dot(forearm_x, hand_x)
            )
        if near is not None:
            q7 += 2 * math.pi * round((near[6] - q7) / (2 * math.pi))
        return [base_yaw, shoulder, 0.0, -elbow, q5, q6, q7]
