"""Articulated: a fixed body with a part that slides out of it along a rail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import pybullet

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.contacts import contacts, is_any_within
from ba_torchrl.sim.geometry import IDENTITY, ORIGIN, Pose, Quaternion, Vector, yaw_quaternion
from ba_torchrl.sim.shapes import Shape, Solid


@dataclass(frozen=True, kw_only=True)
class Rail:
    """Where a part slides, and how hard it is to move.

    Args:
        axis: unit vector of the motion, in the frame of the body.
        range_m: least and greatest travel.
        friction_n: force that the part withstands; it also stops the part when let go.
    """

    axis: Vector = (1.0, 0.0, 0.0)
    range_m: tuple[float, float]
    friction_n: float

    def __post_init__(self) -> None:
        low, high = self.range_m
        if not low <= 0 <= high:
            raise ValueError(f"the range {self.range_m} must contain 0, where the part is put")
        if self.friction_n < 0:
            raise ValueError(f"friction_n must not be negative, it is {self.friction_n}")


class ArticulatedLink(Body):
    """One of the rigid bodies that an articulated body consists of.

    Args:
        client: PyBullet's client id.
        body_id: of the articulated body.
        links: PyBullet's indices of the part, its frame's first; -1 is the fixed base.
        shape: its geometry and material; both parts share the frame of the fixed one at travel 0.
        name: for messages.
    """

    def __init__(
        self, client: int, body_id: int, links: Sequence[int], shape: Shape, name: str
    ) -> None:
        # not Body's: that would load a body of its own
        self.client, self.id, self.links = client, body_id, tuple(links)
        self.shape, self.name = shape, name
        self.is_hidden = False
        for link in links:
            pybullet.changeDynamics(
                self.id,
                link,
                lateralFriction=shape.friction,
                frictionAnchor=1,
                physicsClientId=client,
            )
            if shape.collision_margin_m is not None:
                pybullet.changeDynamics(
                    self.id, link, collisionMargin=shape.collision_margin_m, physicsClientId=client
                )

    @property
    def is_static(self) -> bool:
        """Whether the part never moves."""
        return self.links[0] < 0

    @property
    def is_free(self) -> bool:
        """A part stays on its rail: no gripper can carry it away."""
        return False

    @property
    def pose(self) -> Pose:
        """Pose of the geometry's frame."""
        if self.is_static:
            return Pose(
                *pybullet.getBasePositionAndOrientation(self.id, physicsClientId=self.client)
            )
        state = pybullet.getLinkState(
            self.id, self.links[0], computeForwardKinematics=1, physicsClientId=self.client
        )
        return Pose(state[4], state[5])

    def move_to(self, position: Vector, orientation: Quaternion) -> None:
        """Put the whole articulated body at a pose; only its fixed part can be asked to.

        Raises:
            ValueError: the part moves along its rail only.
        """
        if not self.is_static:
            raise ValueError(f"{self.name} moves along its rail only: place the whole body")
        pybullet.resetBasePositionAndOrientation(
            self.id, position, orientation, physicsClientId=self.client
        )

    def is_still(self, speed_m_s: float, spin_rad_s: float) -> bool:
        """Whether the part moves along its rail no faster than the limit."""
        if self.is_static:
            return True
        state = pybullet.getJointState(self.id, self.links[0], physicsClientId=self.client)
        return abs(state[1]) <= speed_m_s

    def touches(self, other: Body) -> bool:
        """Whether the part, and not its sibling, is in contact with a body as of the last step."""
        points = contacts(self.client, self.id, other.id)
        return is_any_within(point for point in points if point.link in self.links)

    def forget_pairs(self) -> None:
        """Let the engine look afresh at what is near the part."""
        # PyBullet's own groups: what is static meets all but its like
        group, mask = (2, ~2) if self.is_static else (1, -1)
        for link in self.links:
            pybullet.setCollisionFilterGroupMask(
                self.id, link, group, mask, physicsClientId=self.client
            )

    def bounding_box(self) -> tuple[Vector, Vector]:
        """Return the lower and upper corner of the axis-aligned bounding box."""
        boxes = [
            pybullet.getAABB(self.id, link, physicsClientId=self.client) for link in self.links
        ]
        return (
            tuple(min(low[axis] for low, _ in boxes) for axis in range(3)),
            tuple(max(high[axis] for _, high in boxes) for axis in range(3)),
        )


class Articulated:
    """A fixed body and a part that slides along a rail: one PyBullet body with one joint.

    The two parts do not collide with each other; the rail alone guides the sliding one. Every
    convex piece is a link of its own: PyBullet's snapshots mix up the contacts of pieces that
    share one, and the same state would not have the same future.

    Args:
        client: PyBullet's client id.
        base: shape of the fixed part.
        slider: shape of the part that slides, in the frame of the fixed one at travel 0. Where its
            centre of mass lies makes no difference on a rail.
        rail: where it slides.
        name: for messages.

    Raises:
        ValueError: the base has a mass, or the slider has none.
    """

    def __init__(self, client: int, base: Shape, slider: Shape, rail: Rail, name: str) -> None:
        if base.mass_kg != 0 or slider.mass_kg <= 0:
            raise ValueError(f"{name}: its base takes no mass, its slider needs one")
        self.client = client
        self.rail = rail
        self.name = name
        bottom, *fixed = _pieces(base)
        moving = _pieces(slider)
        # links are numbered from 1 where PyBullet asks for parents: 0 is the base
        parents = [0, *[0] * len(fixed), *[1] * (len(moving) - 1)]
        pieces = [moving[0], *fixed, *moving[1:]]
        share = slider.mass_kg / len(moving)
        self.id = pybullet.createMultiBody(
            baseMass=0.0,
            baseCollisionShapeIndex=bottom.create_collision(client),
            baseVisualShapeIndex=base.create_visual(client),
            basePosition=(0.0, 0.0, -base.bounds_m[0][2]),
            linkMasses=[share, *[0.0] * len(fixed), *[share] * (len(moving) - 1)],
            linkCollisionShapeIndices=[piece.create_collision(client) for piece in pieces],
            linkVisualShapeIndices=[slider.create_visual(client), *[-1] * (len(pieces) - 1)],
            linkPositions=[ORIGIN] * len(pieces),
            linkOrientations=[IDENTITY] * len(pieces),
            linkInertialFramePositions=[ORIGIN] * len(pieces),
            linkInertialFrameOrientations=[IDENTITY] * len(pieces),
            linkParentIndices=parents,
            linkJointTypes=[
                pybullet.JOINT_PRISMATIC,
                *[pybullet.JOINT_FIXED] * (len(pieces) - 1),
            ],
            linkJointAxis=[rail.axis] * len(pieces),
            physicsClientId=client,
        )
        links = range(1, len(pieces))
        self.base = ArticulatedLink(client, self.id, [-1, *links[: len(fixed)]], base, name)
        """The fixed part."""
        self.slider = ArticulatedLink(
            client, self.id, [0, *links[len(fixed) :]], slider, f"{name}'s slider"
        )
        """The part that moves."""
        low, high = rail.range_m
        # in a call of their own: next to other settings, PyBullet ignores the limits
        pybullet.changeDynamics(
            self.id,
            0,
            jointLowerLimit=low,
            jointUpperLimit=high,
            physicsClientId=client,
        )
        # a motor that wants standstill and has little force is dry friction
        pybullet.setJointMotorControl2(
            self.id,
            0,
            pybullet.VELOCITY_CONTROL,
            targetVelocity=0.0,
            force=rail.friction_n,
            physicsClientId=client,
        )

    def __repr__(self) -> str:
        return f"Articulated({self.name!r})"

    @property
    def parts(self) -> tuple[ArticulatedLink, ArticulatedLink]:
        """The fixed part and the sliding one."""
        return self.base, self.slider

    @property
    def travel_m(self) -> float:
        """How far the slider is along its rail."""
        return pybullet.getJointState(self.id, 0, physicsClientId=self.client)[0]

    def place(self, position: Vector, yaw_rad: float = 0.0, travel_m: float = 0.0) -> None:
        """Put everything at rest, upright, at a pose and a travel of the slider.

        Raises:
            ValueError: the travel is out of the rail's range.
        """
        low, high = self.rail.range_m
        if not low <= travel_m <= high:
            raise ValueError(f"{self.name}: travel {travel_m} m is outside of {low} to {high} m")
        self.base.move_to(position, yaw_quaternion(yaw_rad))
        pybullet.resetJointState(self.id, 0, travel_m, 0.0, physicsClientId=self.client)


def _pieces(shape: Shape) -> list[Shape]:
    """Return a shape's convex pieces."""
    if not isinstance(shape, Solid):
        return [shape]
    return [replace(shape, parts=(part,), surface=None) for part in shape.parts]
