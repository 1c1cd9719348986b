"""Robot: the interface of an arm with a two-finger gripper."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import ClassVar

import pybullet

from ba_torchrl.registry import Registry
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.contacts import CONTACT_DISTANCE_M, contacts, is_any_within, nearest_points
from ba_torchrl.sim.geometry import (
    IDENTITY,
    Matrix,
    Pose,
    Quaternion,
    Vector,
    YawPose,
    bullet_compose,
    dot,
    perpendicular,
    quaternion_matrix,
)
from ba_torchrl.sim.robots.gripper import Gripper, measured_gripper
from ba_torchrl.sim.world import World

ROBOTS: Registry[type[Robot]] = Registry("robot", "ba_torchrl.sim.robots")

GRASP_NORMAL_COSINE = 0.7
"""A contact contributes to a grasp if its normal is within 45 degrees of the closing axis."""
OPPOSED_COSINE = 0.8
"""A grasp needs contact normals of the two fingers that are opposite within 37 degrees (the
friction cone) in the plane perpendicular to the approach direction, so that the sides of a roof can
slope. The normals of an edge that is wedged between the fingers differ by more."""
GRASP_QUERY_M = 2e-3
"""Maximum distance of the closest points whose normals are examined for a grasp."""

DISTANT_M = 10.0
"""Coordinates outside of every workspace."""


class Robot(ABC):
    """An arm with a two-finger gripper in a world.

    The arm has stiff position motors and reaches commanded joint angles within one physics step;
    callers therefore command small displacements (see `ba_torchrl.sim.control`). Subclasses define
    the constants of the model and its inverse kinematics. The tool frame has its origin between the
    fingertips, its z axis along the approach direction and its x axis along the closing axis, the
    line along which the fingers close.

    Args:
        world: the world into which the robot is loaded.
    """

    arm_joints: ClassVar[tuple[int, ...]]
    """PyBullet indices of the arm joints, from the base to the hand."""
    finger_joints: ClassVar[tuple[int, ...]]
    """PyBullet indices of the two actuated finger joints, left and right."""
    finger_open_signs: ClassVar[tuple[float, float]]
    """Sign of each finger joint's position when the gripper is open."""
    finger_open_position: ClassVar[float]
    """Absolute position of the finger joints when the gripper is fully open, in radians for
    revolute and metres for prismatic joints. The closed position is zero."""
    finger_links: ClassVar[tuple[frozenset[int], frozenset[int]]]
    """PyBullet indices of the links of the left and of the right finger."""
    grasp_normal_signs: ClassVar[tuple[float, float]]
    """For each finger, the sign along the tool's x axis of the normal of a contact with a grasped
    body (from the body to the finger)."""
    non_colliding_links: ClassVar[tuple[int, ...]]
    """Links whose collisions are disabled: the base and the arm."""
    hand_link: ClassVar[int]
    """PyBullet index of the link to which the tool frame is fixed."""
    tool_offset_m: ClassVar[Vector]
    """Position of the tool frame in the frame of the hand link."""
    tool_orientation: ClassVar[Quaternion] = IDENTITY
    """Orientation (x, y, z, w) of the tool frame in the frame of the hand link."""
    home_joints: ClassVar[tuple[float, ...]]
    """Arm joints of the home configuration, in which the robot is outside of every image."""
    has_flat_pads: ClassVar[bool] = True
    """Whether the fingers have flat pads, which touch a face at several contact points. PyBullet
    does not update the normals of such contacts when the hand rotates (see `rebuild_contacts`)."""
    camera_height_m: ClassVar[float]
    """Height of the close-loop camera above the tool point."""
    finger_span_m: ClassVar[float]
    """Distance between the finger squares in the close-loop image of a fully open gripper."""
    hand_half_extents_m: ClassVar[tuple[float, float]] = (0.07, 0.03)
    """Half extents of the open hand above the fingertips, along and perpendicular to the closing
    axis."""

    arm_force: ClassVar[float] = 300.0
    """Maximum torque of an arm joint's motor, newton metres."""
    finger_force: ClassVar[float] = 2.0
    """Maximum torque (newton metres) or force (newtons) of a finger joint's motor; it corresponds
    to 5 to 10 N at the fingertip."""
    finger_speed: ClassVar[float] = 2.0
    """Speed of the finger joints, radians or metres per second. The default is 4 mm per physics
    step at the fingertips; at twice the speed they penetrate objects by a centimetre."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.client = world.client
        self.id = self.load()
        self.joints: list[float] = [0.0] * len(self.arm_joints)
        """Commanded arm joints, radians."""
        self.commanded_opening = 1.0
        """Commanded opening, 0 to 1."""
        self._finger_of_link = {
            link: side for side, links in enumerate(self.finger_links) for link in links
        }
        for link in self.non_colliding_links:
            pybullet.setCollisionFilterGroupMask(self.id, link, 0, 0, physicsClientId=self.client)

    @abstractmethod
    def load(self) -> int:
        """Load the model into the world and return its PyBullet id."""

    @abstractmethod
    def inverse_kinematics(
        self, position: Vector, rotation: Matrix, near: Sequence[float] | None = None
    ) -> list[float] | None:
        """Return the arm joints for a pose of the tool.

        Args:
            position: of the tool point, metres.
            rotation: of the tool, such as `downward(yaw_rad)`.
            near: reference joints, radians; among equivalent solutions, the closest is returned.

        Returns:
            Joint angles in radians; None if the pose is out of reach.
        """

    # -- for subclasses ----------------------------------------------------------------------

    def _widen_joint_limits(self, robot: int) -> None:
        """Widen the joint limits of the arm.

        PyBullet's limit constraint would accelerate a joint that is teleported beyond its limit.
        """
        for joint in self.arm_joints:
            pybullet.changeDynamics(
                robot,
                joint,
                jointLowerLimit=-10,
                jointUpperLimit=10,
                physicsClientId=self.client,
            )

    def _add_gear(
        self, robot: int, first: int, second: int, ratio: float, max_force: float = 50
    ) -> None:
        """Couple two joints by a gear constraint.

        Args:
            robot: PyBullet's id of the robot.
            first: joint index.
            second: joint index.
            ratio: the velocity of the first joint is minus ``ratio`` times that of the second.
            max_force: of the constraint.
        """
        gear = pybullet.createConstraint(
            robot,
            first,
            robot,
            second,
            pybullet.JOINT_GEAR,
            (0, 1, 0),
            (0, 0, 0),
            (0, 0, 0),
            physicsClientId=self.client,
        )
        pybullet.changeConstraint(
            gear, gearRatio=ratio, maxForce=max_force, erp=0.5, physicsClientId=self.client
        )

    # -- arm ---------------------------------------------------------------------------------

    def teleport(self, joints: Sequence[float]) -> None:
        """Set the arm joints, with zero velocities, and command them.

        Args:
            joints: radians.
        """
        self.place_arm(joints)
        self.command(joints)

    def place_arm(self, joints: Sequence[float]) -> None:
        """Set the arm joints, with zero velocities, without a change of the motors' targets.

        Args:
            joints: radians.
        """
        self._set_arm([(q, 0.0) for q in joints])

    def _set_arm(self, states: Sequence[tuple[float, float]]) -> None:
        """Set positions and velocities of the arm joints."""
        positions, velocities = ([[value] for value in row] for row in zip(*states, strict=True))
        pybullet.resetJointStatesMultiDof(
            self.id, self.arm_joints, positions, velocities, physicsClientId=self.client
        )

    def command(self, joints: Sequence[float]) -> None:
        """Set the targets of the arm's motors, which are reached in the next physics step.

        Args:
            joints: radians.
        """
        pybullet.setJointMotorControlArray(
            self.id,
            self.arm_joints,
            pybullet.POSITION_CONTROL,
            joints,
            forces=[self.arm_force] * len(self.arm_joints),
            positionGains=[1.0] * len(self.arm_joints),
            physicsClientId=self.client,
        )
        self.joints = list(joints)

    def measured_joints(self) -> list[float]:
        """Return the current arm joints, radians."""
        states = pybullet.getJointStates(self.id, self.arm_joints, physicsClientId=self.client)
        return [state[0] for state in states]

    def tool_frame(self) -> Pose:
        """Return the pose of the tool frame in the world."""
        state = pybullet.getLinkState(
            self.id, self.hand_link, computeForwardKinematics=1, physicsClientId=self.client
        )
        hand = Pose(state[4], state[5])
        return bullet_compose(hand, Pose(self.tool_offset_m, self.tool_orientation))

    def tool_pose(self) -> YawPose:
        """Return the position of the tool frame and the yaw of its x axis, in [-pi, pi)."""
        tool = self.tool_frame()
        return tool.position, tool.yaw_rad

    def penetrates(self, body_ids: Iterable[int], joints: Sequence[float]) -> bool:
        """Whether hand or arm would penetrate bodies at a configuration.

        The fingers, the base and the first link do not count: bodies may surround the mount. The
        state of the arm is unchanged.

        Args:
            body_ids: PyBullet's ids of the bodies.
            joints: of the arm, radians.
        """
        states = pybullet.getJointStates(self.id, self.arm_joints, physicsClientId=self.client)
        self.place_arm(joints)
        points = [
            point
            for body_id in body_ids
            for point in nearest_points(self.client, self.id, body_id, 0.0)
            if point.link > self.arm_joints[0] and point.link not in self._finger_of_link
        ]
        self._set_arm([state[:2] for state in states])
        return is_any_within(points, 0.0)

    # -- gripper -----------------------------------------------------------------------------

    @property
    def gripper(self) -> Gripper:
        """Dimensions of the gripper, measured on the model."""
        return measured_gripper(type(self))

    def opening(self) -> float:
        """Return the opening of the gripper, from 0 (closed) to 1 (fully open)."""
        states = pybullet.getJointStates(self.id, self.finger_joints, physicsClientId=self.client)
        mean = (
            sum(s * state[0] for s, state in zip(self.finger_open_signs, states, strict=True)) / 2
        )
        return min(max(mean / self.finger_open_position, 0.0), 1.0)

    def set_opening(self, opening: float) -> None:
        """Set the opening of the fingers, with zero velocities, and command it.

        Args:
            opening: 0 to 1.
        """
        pybullet.resetJointStatesMultiDof(
            self.id,
            self.finger_joints,
            [[sign * opening * self.finger_open_position] for sign in self.finger_open_signs],
            [[0.0]] * len(self.finger_joints),
            physicsClientId=self.client,
        )
        self.commanded_opening = opening
        self.command_opening(opening)

    def command_opening(self, opening: float) -> None:
        """Set the targets of the finger motors.

        Args:
            opening: 0 to 1.
        """
        if self.has_flat_pads and self.commanded_opening < min(opening, self.opening()) - 1e-3:
            self.rebuild_contacts()  # the fingers grasped and now release
        pybullet.setJointMotorControlArray(
            self.id,
            self.finger_joints,
            pybullet.POSITION_CONTROL,
            [sign * opening * self.finger_open_position for sign in self.finger_open_signs],
            forces=[self.finger_force] * 2,
            positionGains=[1.0] * 2,
            physicsClientId=self.client,
        )
        self.commanded_opening = opening

    def rebuild_contacts(self) -> None:
        """Delete and detect again the contacts of all free bodies that the fingers touch.

        Bullet does not rotate the normals of persistent contacts with the bodies. After a rotation
        of the hand by half a turn, the normals of a flat face are reversed, and a body would follow
        the opening finger. The poses and velocities of the bodies are unchanged.
        """
        touched = {
            point.other_id
            for point in contacts(self.client, self.id)
            if point.link in self._finger_of_link
        }
        bodies = [body.id for body in self.world.bodies if body.id in touched and body.is_free]
        states = []
        for i, body in enumerate(bodies):
            pose = pybullet.getBasePositionAndOrientation(body, physicsClientId=self.client)
            velocity = pybullet.getBaseVelocity(body, physicsClientId=self.client)
            states.append((body, pose, velocity))
            pybullet.resetBasePositionAndOrientation(
                body, (DISTANT_M, i * DISTANT_M, DISTANT_M), pose[1], physicsClientId=self.client
            )
        if states:
            self.world.detect_collisions()
        for body, pose, velocity in states:
            pybullet.resetBasePositionAndOrientation(body, *pose, physicsClientId=self.client)
            pybullet.resetBaseVelocity(body, *velocity, physicsClientId=self.client)

    # -- state -------------------------------------------------------------------------------

    def get_state(self) -> tuple[list[float], float]:
        """Return the commanded joints and opening, which PyBullet's snapshots do not contain."""
        return list(self.joints), self.commanded_opening

    def set_state(self, state: tuple[list[float], float]) -> None:
        """Command the joints and the opening that `get_state` returned.

        Args:
            state: commanded joints (radians) and opening (0 to 1).
        """
        joints, self.commanded_opening = state
        self.command(joints)
        self.command_opening(self.commanded_opening)

    # -- contacts ----------------------------------------------------------------------------

    def held_body(self) -> Body | None:
        """Return the body that the fingers grasped in the last physics step.

        Only contacts of finger links are considered. Each finger needs a contact whose normal is
        close to the closing axis (`GRASP_NORMAL_COSINE`), and the normals of the two fingers must
        be opposite (`OPPOSED_COSINE`): a block whose corner touches both fingers is not held.
        """
        touching: tuple[set[tuple[int, int]], ...] = (set(), set())
        for point in contacts(self.client, self.id):
            side = self._finger_of_link.get(point.link)
            if side is not None and point.distance_m < CONTACT_DISTANCE_M:
                touching[side].add((point.other_id, point.link))
        both = {body for body, _ in touching[0]} & {body for body, _ in touching[1]}
        for body in self.world.bodies:
            if body.id in both and body.is_free and self._is_grasped(body, touching):
                return body
        return None

    def _is_grasped(self, body: Body, touching: tuple[set[tuple[int, int]], ...]) -> bool:
        """Whether contact normals of the two fingers on a body are opposite.

        Args:
            body: the body.
            touching: for each finger, pairs of the ids of touched bodies and the touching links.
        """
        axis, _, approach = zip(*quaternion_matrix(self.tool_frame().orientation), strict=True)
        left, right = (
            [
                point.normal
                for body_id, link in links
                if body_id == body.id
                # closest points, as the normals of persistent contacts do not rotate with bodies
                for point in nearest_points(self.client, self.id, body.id, GRASP_QUERY_M, link)
                if sign * dot(point.normal, axis) > GRASP_NORMAL_COSINE
            ]
            for sign, links in zip(self.grasp_normal_signs, touching, strict=True)
        )
        return any(
            dot(perpendicular(a, approach), perpendicular(b, approach)) < -OPPOSED_COSINE
            for a in left
            for b in right
        )
