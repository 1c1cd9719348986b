"""ArticulatedBody: a fixed link and a sliding link, connected by a prismatic joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pybullet

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import IDENTITY, ORIGIN, Pose, Quaternion, Vector, yaw_quaternion
from ba_torchrl.sim.meshes import Mesh
from ba_torchrl.sim.shapes import Shape, Solid

LINK_MARGIN_M = 1e-3
"""PyBullet's collision margin of a hull; a link's, except the base's, cannot be changed."""


@dataclass(frozen=True, kw_only=True)
class PrismaticJoint:
    """A sliding joint with limits and dry friction.

    Args:
        axis: unit vector of the motion, in the frame of the body.
        limits_m: lower and upper joint limit, a range that contains the initial position 0.
        friction_n: greatest force of the dry friction.
    """

    axis: Vector = (1.0, 0.0, 0.0)
    limits_m: tuple[float, float]
    friction_n: float

    def __post_init__(self) -> None:
        low, high = self.limits_m
        if not low <= 0 <= high:
            raise ValueError(f"limits_m {self.limits_m} must contain 0, the initial position")
        if self.friction_n < 0:
            raise ValueError(f"friction_n must not be negative, got {self.friction_n}")


class ArticulatedLink(Body):
    """One of the two rigid links of an articulated body.

    Args:
        links: PyBullet's link indices of the convex parts, where the first defines the frame; -1
            is the fixed base.
        shape: geometry, mass and material, in the frame of the fixed link at joint position 0.
    """

    def __init__(
        self, client: int, body_id: int, links: Sequence[int], shape: Shape, name: str
    ) -> None:
        # Body.__init__ is not called: it would load another PyBullet body
        self.client, self.id, self.links = client, body_id, tuple(links)
        self.shape, self.name = shape, name
        self.is_hidden = False
        self._set_material()

    @property
    def is_static(self) -> bool:
        """Whether this is the fixed link."""
        return self.links[0] < 0

    @property
    def is_free(self) -> bool:
        """Return False: a gripper cannot lift a link."""
        return False

    def _read_pose(self) -> Pose:
        if self.is_static:
            return Pose(
                *pybullet.getBasePositionAndOrientation(self.id, physicsClientId=self.client)
            )
        state = pybullet.getLinkState(
            self.id, self.links[0], computeForwardKinematics=1, physicsClientId=self.client
        )
        return Pose(state[4], state[5])

    def set_pose(self, position: Vector, orientation: Quaternion) -> None:
        """Teleport the articulated body; possible only through its fixed link."""
        self._check_can_move()
        if not self.is_static:
            raise ValueError(f"{self.name} moves only along its joint: place the whole body")
        pybullet.resetBasePositionAndOrientation(
            self.id, position, orientation, physicsClientId=self.client
        )

    def is_still(self, speed_m_s: float, spin_rad_s: float) -> bool:
        """Whether the joint velocity is within the limit; the link does not rotate."""
        if self.is_static:
            return True
        state = pybullet.getJointState(self.id, self.links[0], physicsClientId=self.client)
        return abs(state[1]) <= speed_m_s


class ArticulatedBody:
    """A fixed link and a sliding link: one PyBullet body with one prismatic joint.

    The two links do not collide with each other. Each convex part is a separate PyBullet link:
    PyBullet's snapshots confuse the contacts of several convex parts in one link, so that restored
    states would not repeat exactly.

    Args:
        slider: shape of the sliding link, in the frame of the fixed link at joint position 0. Its
            centre of mass has no effect.
    """

    def __init__(
        self, client: int, base: Shape, slider: Shape, joint: PrismaticJoint, name: str
    ) -> None:
        if base.mass_kg != 0 or slider.mass_kg <= 0:
            raise ValueError(f"{name}: the base must have zero mass, the slider a positive mass")
        self.client = client
        self.joint = joint
        self.name = name
        base_part, *fixed = _convex_parts(base)
        moving = _convex_parts(slider)
        # in linkParentIndices, 0 is the base and links count from 1
        parents = [0, *[0] * len(fixed), *[1] * (len(moving) - 1)]
        parts = [_without_link_margin(part) for part in (moving[0], *fixed, *moving[1:])]
        share = slider.mass_kg / len(moving)
        self.id = pybullet.createMultiBody(
            baseMass=0.0,
            baseCollisionShapeIndex=base_part.create_collision(client),
            baseVisualShapeIndex=base.create_visual(client),
            basePosition=(0.0, 0.0, -base.bounds_m[0][2]),
            linkMasses=[share, *[0.0] * len(fixed), *[share] * (len(moving) - 1)],
            linkCollisionShapeIndices=[part.create_collision(client) for part in parts],
            linkVisualShapeIndices=[slider.create_visual(client), *[-1] * (len(parts) - 1)],
            linkPositions=[ORIGIN] * len(parts),
            linkOrientations=[IDENTITY] * len(parts),
            linkInertialFramePositions=[ORIGIN] * len(parts),
            linkInertialFrameOrientations=[IDENTITY] * len(parts),
            linkParentIndices=parents,
            linkJointTypes=[pybullet.JOINT_PRISMATIC, *[pybullet.JOINT_FIXED] * (len(parts) - 1)],
            linkJointAxis=[joint.axis] * len(parts),
            physicsClientId=client,
        )
        links = range(1, len(parts))
        self.base = ArticulatedLink(client, self.id, [-1, *links[: len(fixed)]], base, name)
        """The fixed link."""
        self.slider = ArticulatedLink(
            client, self.id, [0, *links[len(fixed) :]], slider, f"{name}'s slider"
        )
        """The sliding link."""
        low, high = joint.limits_m
        # a separate call: PyBullet ignores joint limits in a call with other settings
        pybullet.changeDynamics(
            self.id, 0, jointLowerLimit=low, jointUpperLimit=high, physicsClientId=client
        )
        # a velocity motor with target zero and limited force acts as dry friction
        pybullet.setJointMotorControl2(
            self.id,
            0,
            pybullet.VELOCITY_CONTROL,
            targetVelocity=0.0,
            force=joint.friction_n,
            physicsClientId=client,
        )

    def __repr__(self) -> str:
        return f"ArticulatedBody({self.name!r})"

    @property
    def parts(self) -> tuple[ArticulatedLink, ArticulatedLink]:
        """The fixed link and the sliding link."""
        return self.base, self.slider

    @property
    def travel_m(self) -> float:
        """Position of the joint."""
        return pybullet.getJointState(self.id, 0, physicsClientId=self.client)[0]

    def place(self, position: Vector, yaw_rad: float = 0.0, travel_m: float = 0.0) -> None:
        """Teleport the fixed link to an upright pose and the joint to a position, at rest."""
        low, high = self.joint.limits_m
        if not low <= travel_m <= high:
            raise ValueError(f"{self.name}: travel_m {travel_m} is outside of [{low}, {high}]")
        self.base.set_pose(position, yaw_quaternion(yaw_rad))
        pybullet.resetJointState(self.id, 0, travel_m, 0.0, physicsClientId=self.client)


def _convex_parts(shape: Shape) -> list[Shape]:
    """Return the convex parts of a shape, each as a shape."""
    if not isinstance(shape, Solid):
        return [shape]
    return [replace(shape, parts=(part,), surface=None) for part in shape.parts]


def _without_link_margin(part: Shape) -> Shape:
    """Return the collision geometry of a link, which PyBullet encloses in a fixed margin.

    A hull is smaller by the difference between that margin and the shape's own. This is exact for
    boxes and cylinders along the axes of the frame.
    """
    if part.collision_margin_m is None:
        return part
    (mesh,) = part.parts
    low, high = np.array(part.bounds_m)
    excess_m = LINK_MARGIN_M - part.collision_margin_m
    factors = np.maximum(high - low - 2 * excess_m, 0.0) / (high - low)
    center = (low + high) / 2
    return replace(part, parts=(Mesh(center + factors * (mesh.vertices - center), mesh.faces),))
