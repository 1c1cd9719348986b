"""UR5 with a parallel-jaw or Robotiq 2F-85 gripper: models and closed-form inverse kinematics."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar
from xml.etree import ElementTree

import pybullet

from ba_torchrl.sim.geometry import Matrix, Vector, cross, dot
from ba_torchrl.sim.robots.base import ROBOTS, Robot, add_gear
from ba_torchrl.sim.world import loading

_MODELS = Path(__file__).parent / "models"

_SHOULDER_HEIGHT_M = 0.089159
_UPPER_ARM_M = 0.425
_FOREARM_M = 0.39225
_WRIST_1_M = 0.10915
_WRIST_2_M = 0.09465
_WRIST_3_M = 0.0823
_BASE_M = (-0.05, 0.0, 0.1)


class UR5(Robot):
    """Universal Robots UR5, a six-joint arm (paper section 3.4); subclasses add the gripper.

    The model is `models/ur5_arm.urdf` of this package, with the published Denavit-Hartenberg
    parameters and simplified visual shapes.
    """

    gripper_model: ClassVar[str]
    """File in `models/`, whose root link is attached to the link "flange" of the arm."""

    arm_joints = tuple(range(6))
    non_colliding_links = tuple(range(-1, 6))
    hand_link = 6
    finger_span_m = 42 * 0.3 / 128

    def load(self) -> int:
        """Load arm and gripper as one model."""
        models = (_MODELS / "ur5_arm.urdf", _MODELS / self.gripper_model)
        return _load_joined(models, _BASE_M, self.client)

    def inverse_kinematics(
        self, position: Vector, rotation: Matrix, near: Sequence[float] | None = None
    ) -> list[float] | None:
        """Return the arm joints for a pose of the tool; see `Robot.inverse_kinematics`.

        Of the eight solutions, the one with the shoulder forward, the elbow up and wrist 2 pointing
        outwards is returned. It is continuous in the workspace unless the tool is horizontal.
        """
        finger, _, approach = zip(*rotation, strict=True)
        tool_distance = _WRIST_3_M + self.tool_offset_m[2]
        x, y, z = (
            p - tool_distance * a - b for p, a, b in zip(position, approach, _BASE_M, strict=True)
        )
        radius = math.hypot(x, y)
        if radius < _WRIST_1_M:
            return None
        # the vertical plane of the arm is offset from the wrist
        base_yaw = math.atan2(y, x) - math.asin(_WRIST_1_M / radius)
        c1, s1 = math.cos(base_yaw), math.sin(base_yaw)
        front, side = (c1, s1, 0.0), (-s1, c1, 0.0)
        cos5 = min(max(dot(approach, side), -1.0), 1.0)
        q5 = -math.acos(cos5)
        sin5 = math.sqrt(1 - cos5 * cos5)
        if sin5 < 1e-6:
            return None  # wrist singularity: the last axis is parallel to the axes of joints 2 to 4
        across = tuple((a - cos5 * s) / sin5 for a, s in zip(approach, side, strict=True))
        wrist_2 = cross(across, side)  # axis of joint 5
        total = math.atan2(across[2], -dot(across, front))  # sum of joints 2, 3 and 4
        # joints 2 and 3: a planar arm with two links
        u = math.sqrt(radius**2 - _WRIST_1_M**2) - _WRIST_2_M * dot(wrist_2, front)
        v = z - _WRIST_2_M * wrist_2[2] - _SHOULDER_HEIGHT_M
        cos3 = (u**2 + v**2 - _UPPER_ARM_M**2 - _FOREARM_M**2) / (2 * _UPPER_ARM_M * _FOREARM_M)
        if abs(cos3) > 1:
            return None
        q3 = math.acos(cos3)
        q2 = -math.atan2(v, u) - math.atan2(
            _FOREARM_M * math.sin(q3), _UPPER_ARM_M + _FOREARM_M * cos3
        )
        axis_x = tuple(cos5 * a - sin5 * s for a, s in zip(across, side, strict=True))
        q6 = math.atan2(-dot(finger, wrist_2), dot(finger, axis_x))
        if near is not None:
            q6 += 2 * math.pi * round((near[5] - q6) / (2 * math.pi))
        return [base_yaw, q2, q3, total - q2 - q3, q5, q6]


@ROBOTS.register("ur5")
class UR5ParallelJaw(UR5):
    """UR5 with a parallel-jaw gripper, whose two fingers move on prismatic joints.

    The model of the gripper is `models/parallel_jaw.urdf` of this package.
    """

    gripper_model = "parallel_jaw.urdf"

    finger_joints = (7, 8)
    finger_open_signs = (1.0, 1.0)
    finger_open_position = 0.04
    finger_links = (frozenset({7}), frozenset({8}))
    grasp_normal_signs = (1.0, -1.0)
    tool_offset_m = (0.0, 0.0, 0.1413)
    home_joints = (0.954, -1.732, 1.566, -1.404, -1.571, -0.617)
    camera_height_m = 0.06

    finger_force = 10.0
    finger_speed = 0.4


@ROBOTS.register("ur5_robotiq")
class UR5Robotiq(UR5):
    """UR5 with a Robotiq 2F-85 gripper, whose finger pads move on arcs and stay parallel.

    The model of the gripper is `models/robotiq_2f85.urdf` of this package, with the dimensions of
    the published linkage.
    """

    gripper_model = "robotiq_2f85.urdf"

    finger_joints = (7, 10)
    finger_open_signs = (1.0, 1.0)
    finger_open_position = 0.8
    finger_links = (frozenset({7, 8, 9}), frozenset({10, 11, 12}))
    grasp_normal_signs = (1.0, -1.0)
    tool_offset_m = (0.0, 0.0, 0.1543)
    home_joints = (0.954, -1.727, 1.529, -1.372, -1.571, -0.617)
    camera_height_m = 0.04
    hand_half_extents_m = (0.08, 0.03)

    finger_force = 0.6
    finger_speed = 7.5

    _followers: ClassVar[dict[int, int]] = {8: 7, 9: 7, 11: 10, 12: 10}
    """Joints of each side's finger and inner knuckle, and the actuated joint that they follow."""

    def load(self) -> int:
        """Load the model and couple the joints of the linkage by gears."""
        robot = super().load()
        for joint in self._followers:
            pybullet.setJointMotorControl2(
                robot, joint, pybullet.VELOCITY_CONTROL, force=0, physicsClientId=self.client
            )
        for joint, driver in self._followers.items():
            add_gear(self.client, robot, (driver, joint), ratio=-1)
        return robot

    def set_opening(self, opening: float) -> None:
        """Set the opening of all joints of the linkage, with zero velocities."""
        positions = [opening * self.finger_open_position] * len(self._followers)
        self._reset_joints(list(self._followers), positions)
        super().set_opening(opening)


def _load_joined(models: Sequence[Path], base_m: Vector, client: int) -> int:
    """Load several URDF files as one body and return its PyBullet id.

    A joint can connect links of different files.
    """
    joined = ElementTree.Element("robot", name="+".join(model.stem for model in models))
    materials = set()
    for model in models:
        for part in ElementTree.parse(model).getroot():
            if part.tag == "material" and part.get("name") in materials:
                continue
            materials.add(part.get("name"))
            for mesh in part.iter("mesh"):
                mesh.set("filename", str(model.with_name(mesh.get("filename"))))
            joined.append(part)
    file, name = tempfile.mkstemp(suffix=".urdf")  # PyBullet loads models only from files
    try:
        with os.fdopen(file, "wb") as out:
            ElementTree.ElementTree(joined).write(out)
        with loading(name):
            return pybullet.loadURDF(
                name,
                base_m,
                useFixedBase=True,
                flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
                physicsClientId=client,
            )
    finally:
        os.unlink(name)
