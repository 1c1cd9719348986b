"""Robot: the interface of an arm with a two-finger gripper."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import ClassVar

import numpy as np
import pybullet

from ba_torchrl.core.registry import Registry
from ba_torchrl.sim.bodies import Body, set_asleep
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
    downward,
    perpendicular,
    quaternion_matrix,
)
from ba_torchrl.sim.robots.gripper import TIP_HEIGHT_M, Gripper
from ba_torchrl.sim.world import World, decimal_point

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

_OPENINGS = tuple(np.linspace(0.0, 1.0, 9).tolist())
_OUTLINE_SPACING_M = 5e-3
_RAY_SPACING_M = 1e-3
_MAX_U_M, _MAX_V_M = 0.14, 0.02
_RAY_START_BELOW_M, _RAY_END_ABOVE_M = 0.05, 0.1
_CHAMFER_M = 2e-3
_RAYS_AT_ONCE = 8192
_POSITION = (0.45, 0.0, 0.25)


class Robot(ABC):
    """An arm with a two-finger gripper in a world.

    The arm has stiff position motors and reaches commanded joint angles within one physics step;
    callers therefore command small displacements (see `ba_torchrl.sim.control`). Subclasses define
    the constants of the model and its inverse kinematics. The tool frame has its origin between the
    fingertips, its z axis along the approach direction and its x axis along the closing axis, the
    line along which the fingers close. Joint angles are in radians, openings of the gripper from 0
    (closed) to 1 (fully open).
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
    finger_gear_ratio: ClassVar[float] = -1.0
    """Minus the ratio of the left finger joint's velocity to the right one's. Without such
    a gear, two fingers with limited force do not resist motion of a held body along the closing
    axis."""
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
        with decimal_point(self.client):
            self.id = self.load()
        self.joints: list[float] = [0.0] * len(self.arm_joints)
        """Commanded arm joints."""
        self.commanded_opening = 1.0
        """Commanded opening, 0 to 1."""
        self._finger_of_link = {
            link: side for side, links in enumerate(self.finger_links) for link in links
        }
        for joint in self.arm_joints:
            # PyBullet's limit constraint would accelerate a joint that is teleported beyond it
            pybullet.changeDynamics(
                self.id, joint, jointLowerLimit=-10, jointUpperLimit=10, physicsClientId=self.client
            )
        add_gear(self.client, self.id, self.finger_joints, self.finger_gear_ratio)
        for link in self.non_colliding_links:
            pybullet.setCollisionFilterGroupMask(self.id, link, 0, 0, physicsClientId=self.client)

    @abstractmethod
    def load(self) -> int:
        """Load the model into the world and return its PyBullet id."""

    @abstractmethod
    def inverse_kinematics(
        self, position: Vector, rotation: Matrix, near: Sequence[float] | None = None
    ) -> list[float] | None:
        """Return the arm joints for a pose of the tool; None if it is out of reach.

        Args:
            position: of the tool point, metres.
            rotation: of the tool, such as `downward(yaw_rad)`.
            near: reference joints; among equivalent solutions, the closest is returned.
        """

    # -- arm ---------------------------------------------------------------------------------

    def teleport(self, joints: Sequence[float]) -> None:
        """Set the arm joints, with zero velocities, and command them."""
        self.place_arm(joints)
        self.command(joints)

    def place_arm(self, joints: Sequence[float]) -> None:
        """Set the arm joints, with zero velocities, without a change of the motors' targets."""
        self._reset_joints(self.arm_joints, joints)

    def _reset_joints(
        self, indices: Sequence[int], positions: Sequence[float], velocities: Sequence[float] = ()
    ) -> None:
        """Set positions of joints, and their velocities, which are zero by default."""
        pybullet.resetJointStatesMultiDof(
            self.id,
            indices,
            [[position] for position in positions],
            [[velocity] for velocity in velocities or [0.0] * len(indices)],
            physicsClientId=self.client,
        )

    def _drive(self, indices: Sequence[int], targets: Sequence[float], force: float) -> None:
        """Set the targets of the motors of joints."""
        pybullet.setJointMotorControlArray(
            self.id,
            indices,
            pybullet.POSITION_CONTROL,
            targets,
            forces=[force] * len(indices),
            positionGains=[1.0] * len(indices),
            physicsClientId=self.client,
        )

    def command(self, joints: Sequence[float]) -> None:
        """Set the targets of the arm's motors, which are reached in the next physics step."""
        self._drive(self.arm_joints, joints, self.arm_force)
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
        """
        states = pybullet.getJointStates(self.id, self.arm_joints, physicsClientId=self.client)
        self.place_arm(joints)
        points = [
            point
            for body_id in body_ids
            for point in nearest_points(self.client, self.id, body_id, 0.0)
            if point.link > self.arm_joints[0] and point.link not in self._finger_of_link
        ]
        self._reset_joints(self.arm_joints, *zip(*(state[:2] for state in states), strict=True))
        return is_any_within(points, 0.0)

    def link_positions(self) -> list[Vector]:
        """Return the origins of the base and of the links, metres."""
        client = {"physicsClientId": self.client}
        links = range(pybullet.getNumJoints(self.id, **client))
        states = pybullet.getLinkStates(self.id, links, computeForwardKinematics=1, **client)
        base, _ = pybullet.getBasePositionAndOrientation(self.id, **client)
        return [base, *(state[4] for state in states)]

    # -- gripper -----------------------------------------------------------------------------

    @property
    def gripper(self) -> Gripper:
        """Dimensions of the gripper, measured on the model."""
        return measured_gripper(type(self))

    def opening(self) -> float:
        """Return the opening of the gripper, from 0 (closed) to 1 (fully open)."""
        return min(max(self.finger_motion()[0], 0.0), 1.0)

    def finger_motion(self) -> tuple[float, float]:
        """Return the opening without limits, and its rate of change per second.

        The opening is below 0 or above 1 for fingers that have moved past the closed or the fully
        open position, where neither the joints nor contacts between the fingers stop them.
        """
        states = pybullet.getJointStates(self.id, self.finger_joints, physicsClientId=self.client)
        position, velocity = (
            sum(s * state[i] for s, state in zip(self.finger_open_signs, states, strict=True)) / 2
            for i in (0, 1)
        )
        return position / self.finger_open_position, velocity / self.finger_open_position

    def set_opening(self, opening: float) -> None:
        """Set the opening of the fingers, with zero velocities, and command it."""
        self._reset_joints(self.finger_joints, self._finger_positions(opening))
        self.commanded_opening = opening
        self.command_opening(opening)

    def command_opening(self, opening: float) -> None:
        """Set the targets of the finger motors."""
        if self.has_flat_pads and self.commanded_opening < min(opening, self.opening()) - 1e-3:
            self.rebuild_contacts()  # the fingers grasped and now release
        self._drive(self.finger_joints, self._finger_positions(opening), self.finger_force)
        self.commanded_opening = opening

    def _finger_positions(self, opening: float) -> list[float]:
        return [sign * opening * self.finger_open_position for sign in self.finger_open_signs]

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
        """Command the joints and the opening that `get_state` returned."""
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

        ``touching`` has, for each finger, pairs of the ids of touched bodies and of its links.
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


ROBOTS: Registry[type[Robot]] = Registry("robot", "ba_torchrl.sim.robots", Robot)


def add_gear(client: int, robot: int, joints: tuple[int, int], ratio: float) -> None:
    """Couple two joints: the first has minus ``ratio`` times the second's velocity."""
    axes = (0, 1, 0), (0, 0, 0), (0, 0, 0)
    gear = pybullet.createConstraint(
        robot, joints[0], robot, joints[1], pybullet.JOINT_GEAR, *axes, physicsClientId=client
    )
    pybullet.changeConstraint(gear, gearRatio=ratio, maxForce=50, erp=0.5, physicsClientId=client)


REST_JOINT_RAD = 1e-3
"""Largest deviation from the commanded joints, and largest velocity (rad/s), of an arm at rest."""
REST_OPENING = 1e-3
"""Largest deviation from the commanded opening of fingers at rest."""


class RobotSleep:
    """Puts a robot at rest into Bullet's sleeping state, in which its joints are not simulated.

    Bodies that do not touch the robot move as they do beside one that is awake, except for the
    number of solver iterations where a residual ends them early. Bullet simulates a sleeping robot
    again as soon as a moving body touches it.
    """

    def __init__(self, robot: Robot, is_empty: Callable[[], bool]) -> None:
        self.robot = robot
        self.is_empty = is_empty

    def is_possible(self) -> bool:
        """Whether the robot holds and touches nothing and is at rest where it is commanded to."""
        if not self.is_empty():
            return False
        robot = self.robot
        states = pybullet.getJointStates(robot.id, robot.arm_joints, physicsClientId=robot.client)
        return (
            all(
                abs(state[0] - joint) < REST_JOINT_RAD and abs(state[1]) < REST_JOINT_RAD
                for state, joint in zip(states, robot.joints, strict=True)
            )
            and abs(robot.opening() - robot.commanded_opening) < REST_OPENING
            and not contacts(robot.client, robot.id)
        )

    def set_asleep(self, is_asleep: bool) -> None:
        """Set the state, which takes effect at the end of the next physics step."""
        set_asleep(self.robot.client, self.robot.id, is_asleep)


@cache
def measured_gripper(robot: type[Robot]) -> Gripper:
    """Return the gripper of a robot class, measured once per process.

    The measurement casts rays from below in a temporary world, which takes tenths of a second. The
    rays hit the collision shapes including their margins, as contacts do.
    """
    us = np.arange(0.0, _MAX_U_M + _RAY_SPACING_M / 2, _RAY_SPACING_M)
    vs = np.arange(-_MAX_V_M, _MAX_V_M + _RAY_SPACING_M / 2, _RAY_SPACING_M)
    with World() as world:
        body = robot(world)
        body.teleport(body.inverse_kinematics(_POSITION, downward(0.0)))
        closed, opened = (_underside(body, opening, us, vs) for opening in (0.0, 1.0))
        lines = [_underside(body, opening, us, np.zeros(1))[:, 0] for opening in _OPENINGS]

    tip_arc, palm = [], np.inf
    for heights in lines:
        gap = us[_are_tips(heights)].min()
        tip_arc.append((float(gap), float(heights.min())))
        palm = min([palm, *heights[us < gap - _CHAMFER_M]])
    tips = _are_tips(opened)
    return Gripper(
        half_gap_m=tip_arc[-1][0],
        half_width_m=float(np.abs(vs[tips.any(axis=0)]).max()) + _RAY_SPACING_M / 2,
        closed_half_m=float(us[_are_tips(closed).any(axis=1)].max()) + _RAY_SPACING_M / 2,
        palm_height_m=float(palm),
        tip_arc=tuple(tip_arc),
        outline=_outline(us, opened),
        closed_outline=_outline(us, closed),
    )


def _outline(us: np.ndarray, heights: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Return pairs of distance and least height around it, up to the end of the gripper."""
    profile = heights.min(axis=1)
    reach = us[np.isfinite(profile)].max()
    return tuple(
        (float(u), float(profile[np.abs(us - u) < _OUTLINE_SPACING_M / 2].min()))
        for u in np.arange(0.0, reach + _OUTLINE_SPACING_M / 2, _OUTLINE_SPACING_M)
    )


def _are_tips(heights: np.ndarray) -> np.ndarray:
    return heights < heights.min() + TIP_HEIGHT_M


def _underside(robot: Robot, opening: float, us: np.ndarray, vs: np.ndarray) -> np.ndarray:
    """Return the least height [U, V] of a gripper that points straight down above the tool point.

    It is the lower of the two sides; infinity where no ray hits the gripper.

    Args:
        us: [U] distances along the closing axis, taken on both sides of the tool point.
        vs: [V] coordinates perpendicular to the closing axis.
    """
    robot.set_opening(opening)
    robot.world.detect_collisions()
    (x, y, z), _ = robot.tool_pose()
    grid = np.stack(np.meshgrid(np.concatenate([us, -us]), vs, indexing="ij"), -1).reshape(-1, 2)
    low, high = (
        np.column_stack([grid + np.array([x, y]), np.full(len(grid), z + height)])
        for height in (-_RAY_START_BELOW_M, _RAY_END_ABOVE_M)
    )
    hits = [
        hit
        for i in range(0, len(grid), _RAYS_AT_ONCE)
        for hit in pybullet.rayTestBatch(
            low[i : i + _RAYS_AT_ONCE].tolist(),
            high[i : i + _RAYS_AT_ONCE].tolist(),
            physicsClientId=robot.client,
        )
    ]
    heights = np.array([hit[3][2] - z if hit[0] == robot.id else np.inf for hit in hits])
    return heights.reshape(2, len(us), len(vs)).min(axis=0)
