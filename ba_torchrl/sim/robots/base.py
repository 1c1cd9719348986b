"""Robot: an arm with a two-finger gripper, as the rest of the simulator sees it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
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
"""A finger squeezes what it touches within 45 degrees of the line it closes on."""
OPPOSED_COSINE = 0.8
"""Two fingers hold a body if they press on it from opposite sides, within the friction cone, as
seen along the approach: the sides of a roof may slope. An edge pushed into the wedge between them
meets their surfaces at twice that angle: it is not held."""

_DISTANT_M = 10.0

GRASP_QUERY_M = 2e-3
"""Distance up to which a fresh query looks for the surfaces in contact."""


class Robot(ABC):
    """An arm with a parallel gripper in a world.

    The arm follows stiff position motors, so that it is where it was told to be after one step;
    whoever moves it keeps the steps small. Subclasses give the model's numbers and its inverse
    kinematics. A robot is commanded in joint angles; `ba_torchrl.sim.control` plans them.
    """

    arm_joints: ClassVar[tuple[int, ...]]
    finger_joints: ClassVar[tuple[int, ...]]
    """The two driven joints of the gripper, left and right."""
    finger_open_signs: ClassVar[tuple[float, float]]
    """Sign of each finger's joint position when open."""
    finger_open_position: ClassVar[float]
    """Joint position, up to the sign, of the fully open gripper: radians or metres, as are the
    finger speed and force below. Closed is zero."""
    finger_links: ClassVar[tuple[frozenset[int], frozenset[int]]]
    """Links that belong to the left and to the right finger."""
    grasp_normal_signs: ClassVar[tuple[float, float]]
    """Sign along the tool's x axis in which each finger is pushed back by what it holds."""
    non_colliding_links: ClassVar[tuple[int, ...]]
    """Links that collide with nothing: the arm, which stays above everything it works on."""
    hand_link: ClassVar[int]
    """The link that the tool point is fixed to."""
    tool_offset_m: ClassVar[Vector]
    """Tool point between the fingertips, in the frame of the hand link."""
    tool_orientation: ClassVar[Quaternion] = IDENTITY
    """Orientation of the tool in the frame of the hand link (x, y, z, w): the fingers open along
    its x axis, its z axis is the direction of approach."""
    home_joints: ClassVar[tuple[float, ...]]
    """Arm joints with which hand and arm are beside and above the workspace, out of any picture."""
    has_flat_pads: ClassVar[bool] = True
    """The fingers touch a face by several points at once, which grow stale as the hand turns."""
    camera_height_m: ClassVar[float]
    """The close-loop camera hangs this far above the tool point."""
    finger_span_m: ClassVar[float]
    """Distance between the finger squares in the close-loop image when fully open."""
    hand_half_extents_m: ClassVar[tuple[float, float]] = (0.07, 0.03)
    """Half the extents of the open hand above its fingertips, along the line on which it closes and
    across."""

    arm_force: ClassVar[float] = 300.0
    finger_force: ClassVar[float] = 2.0
    """Largest torque or force of a finger's motor; 5 to 10 N at the tip."""
    finger_speed: ClassVar[float] = 2.0
    """Speed of the finger joints per second: 4 mm per step at the tips. Twice as fast, they sink a
    centimetre into what they meet."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.client = world.client
        self.id = self.load()
        self.joints: list[float] = [0.0] * len(self.arm_joints)
        """Commanded arm joints in radians."""
        self.commanded_opening = 1.0
        self._finger_of_link = {
            link: side for side, links in enumerate(self.finger_links) for link in links
        }
        for link in self.non_colliding_links:
            pybullet.setCollisionFilterGroupMask(self.id, link, 0, 0, physicsClientId=self.client)

    @abstractmethod
    def load(self) -> int:
        """Load the model and return its PyBullet id."""

    @abstractmethod
    def inverse_kinematics(
        self, position: Vector, rotation: Matrix, near: Sequence[float] | None = None
    ) -> list[float] | None:
        """Return arm joints that bring the tool to a pose, or None if it is out of reach.

        Args:
            position: tool point in metres.
            rotation: orientation of the tool; `downward` makes those of top-down grasps.
            near: joints to stay close to where several solutions exist.
        """

    # -- for subclasses ----------------------------------------------------------------------

    def _widen_joint_limits(self, robot: int) -> None:
        """Widen the arm's joint limits: a joint put beyond one is flung back by its constraint."""
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
        """Couple two joints: the first moves by minus ``ratio`` times what the second does."""
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
        """Put the arm at rest at ``joints`` and command it to stay."""
        pybullet.resetJointStatesMultiDof(
            self.id,
            self.arm_joints,
            [[q] for q in joints],
            [[0.0]] * len(self.arm_joints),
            physicsClientId=self.client,
        )
        self.command(joints)

    def command(self, joints: Sequence[float]) -> None:
        """Command the arm's motors to ``joints``, to be reached in the next step."""
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
        """Return the arm's joint angles as they are."""
        states = pybullet.getJointStates(self.id, self.arm_joints, physicsClientId=self.client)
        return [state[0] for state in states]

    def tool_frame(self) -> Pose:
        """Return the pose of the tool."""
        state = pybullet.getLinkState(
            self.id, self.hand_link, computeForwardKinematics=1, physicsClientId=self.client
        )
        hand = Pose(state[4], state[5])
        return bullet_compose(hand, Pose(self.tool_offset_m, self.tool_orientation))

    def tool_pose(self) -> YawPose:
        """Return the tool point and the gripper's yaw in [-pi, pi)."""
        tool = self.tool_frame()
        # the fingers open along the tool's x axis
        return tool.position, tool.yaw_rad

    # -- gripper -----------------------------------------------------------------------------

    @property
    def gripper(self) -> Gripper:
        """The gripper's outline, measured on the model."""
        return measured_gripper(type(self))

    def opening(self) -> float:
        """Return how far the gripper is open, 0 to 1."""
        states = pybullet.getJointStates(self.id, self.finger_joints, physicsClientId=self.client)
        mean = (
            sum(s * state[0] for s, state in zip(self.finger_open_signs, states, strict=True)) / 2
        )
        return min(max(mean / self.finger_open_position, 0.0), 1.0)

    def set_opening(self, opening: float) -> None:
        """Put the fingers at rest at an opening and hold them there."""
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
        """Command the fingers to an opening."""
        if self.has_flat_pads and self.commanded_opening < min(opening, self.opening()) - 1e-3:
            self.rebuild_contacts()  # they squeezed, now they let go
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
        """Have what the fingers touch lose and find its contacts anew, without moving it.

        Bullet keeps the normals of lasting contacts as they were in the world. Once the hand has
        turned by half a turn, those of a flat face point the wrong way, and instead of pushing
        the opening fingers off they would pull the body along.
        """
        touched = {
            point.other_id
            for point in contacts(self.client, self.id)
            if point.link in self._finger_of_link
        }
        bodies = [body.id for body in self.world.bodies if body.id in touched and body.is_free]
        kept = []
        for i, body in enumerate(bodies):
            pose = pybullet.getBasePositionAndOrientation(body, physicsClientId=self.client)
            velocity = pybullet.getBaseVelocity(body, physicsClientId=self.client)
            kept.append((body, pose, velocity))
            pybullet.resetBasePositionAndOrientation(
                body, (_DISTANT_M, i * _DISTANT_M, _DISTANT_M), pose[1], physicsClientId=self.client
            )
        if kept:
            self.world.detect_collisions()
        for body, pose, velocity in kept:
            pybullet.resetBasePositionAndOrientation(body, *pose, physicsClientId=self.client)
            pybullet.resetBaseVelocity(body, *velocity, physicsClientId=self.client)

    # -- state -------------------------------------------------------------------------------

    def get_state(self) -> tuple[list[float], float]:
        """Return the motors' commands, which PyBullet's own snapshots leave out."""
        return list(self.joints), self.commanded_opening

    def set_state(self, state: tuple[list[float], float]) -> None:
        """Repeat the commands that `get_state` returned."""
        joints, self.commanded_opening = state
        self.command(joints)
        self.command_opening(self.commanded_opening)

    # -- contacts ----------------------------------------------------------------------------

    def held_body(self) -> Body | None:
        """Return the body squeezed between the fingers, as of the last step.

        Only contacts of finger links count. Both fingers must press on it from opposite sides,
        along the line they close on up to what friction can bear: a block whose corner rests
        against both fingers is not held.
        """
        touching: tuple[set[tuple[int, int]], ...] = (set(), set())
        for point in contacts(self.client, self.id):
            side = self._finger_of_link.get(point.link)
            if side is not None and point.distance_m < CONTACT_DISTANCE_M:
                touching[side].add((point.other_id, point.link))
        both = {body for body, _ in touching[0]} & {body for body, _ in touching[1]}
        for body in self.world.bodies:
            if body.id in both and body.is_free and self._is_squeezed(body, touching):
                return body
        return None

    def _is_squeezed(self, body: Body, touching: tuple[set[tuple[int, int]], ...]) -> bool:
        """Whether a link of each finger pushes the body towards the other finger."""
        axis, _, approach = zip(*quaternion_matrix(self.tool_frame().orientation), strict=True)
        left, right = (
            [
                point.normal
                for body_id, link in links
                if body_id == body.id
                # a fresh query: normals of lasting contacts do not turn with the bodies
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

    def is_near_anything(self, margin_m: float = 1e-3) -> bool:
        """Whether the hand is closer than ``margin_m`` to a body or the floor, as of now."""
        self.world.detect_collisions()
        return is_any_within(contacts(self.client, self.id), margin_m)
