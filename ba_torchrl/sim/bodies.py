"""Body: a rigid body of a world, and measurements of its surface as it lies."""

from __future__ import annotations

import math

import numpy as np
import pybullet

from ba_torchrl.sim.contacts import contacts, is_any_within
from ba_torchrl.sim.geometry import (
    Pose,
    Quaternion,
    Vector,
    bullet_compose,
    quaternion_tilt,
    yaw_quaternion,
)
from ba_torchrl.sim.shapes import Shape


class Body:
    """A rigid body in a PyBullet client.

    Args:
        client: PyBullet's client id.
        shape: geometry and material.
        name: for messages.
    """

    def __init__(self, client: int, shape: Shape, name: str) -> None:
        self.client = client
        self.shape = shape
        self.name = name
        self.is_hidden = False
        """Put aside for now: cameras and settling leave it out."""
        # PyBullet's poses are of the centre of mass
        self._center = Pose(shape.center_of_mass_m) if any(shape.center_of_mass_m) else None
        self._from_center = None if self._center is None else self._center.inverse()
        self.id = pybullet.createMultiBody(
            baseMass=shape.mass_kg,
            baseCollisionShapeIndex=shape.create_collision(client),
            baseVisualShapeIndex=shape.create_visual(client),
            basePosition=(0.0, 0.0, -shape.bounds_m[0][2]),
            baseInertialFramePosition=shape.center_of_mass_m,
            physicsClientId=client,
        )
        pybullet.changeDynamics(
            self.id,
            -1,
            lateralFriction=shape.friction,
            frictionAnchor=1,  # a held or stacked body must not creep
            physicsClientId=client,
        )
        if shape.collision_margin_m is not None:
            pybullet.changeDynamics(
                self.id, -1, collisionMargin=shape.collision_margin_m, physicsClientId=client
            )

    def __repr__(self) -> str:
        return f"Body({self.name!r})"

    @property
    def is_static(self) -> bool:
        """Whether the body never moves."""
        return self.shape.mass_kg == 0

    @property
    def is_free(self) -> bool:
        """Whether a gripper can carry the body away."""
        return not self.is_static

    @property
    def pose(self) -> Pose:
        """Pose of the geometry's frame."""
        pose = Pose(*pybullet.getBasePositionAndOrientation(self.id, physicsClientId=self.client))
        return pose if self._from_center is None else bullet_compose(pose, self._from_center)

    @property
    def position(self) -> Vector:
        """Position of the origin in metres."""
        return self.pose[0]

    @property
    def yaw_rad(self) -> float:
        """Heading of the body's x axis in the plane."""
        return self.pose.yaw_rad

    @property
    def tilt_rad(self) -> float:
        """Angle between the body's z axis and the vertical."""
        return quaternion_tilt(self.pose.orientation)

    def place(self, position: Vector, yaw_rad: float = 0.0) -> None:
        """Put the body at rest, upright, at a pose."""
        self.move_to(position, yaw_quaternion(yaw_rad))

    def move_to(self, position: Vector, orientation: Quaternion) -> None:
        """Put the body at rest at any pose."""
        if self._center is not None:
            position, orientation = bullet_compose(Pose(position, orientation), self._center)
        pybullet.resetBasePositionAndOrientation(
            self.id, position, orientation, physicsClientId=self.client
        )
        pybullet.resetBaseVelocity(
            self.id, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), physicsClientId=self.client
        )

    def is_still(self, speed_m_s: float, spin_rad_s: float) -> bool:
        """Whether neither velocity exceeds its limit (sums of absolute components)."""
        v, w = pybullet.getBaseVelocity(self.id, physicsClientId=self.client)
        return (
            abs(v[0]) + abs(v[1]) + abs(v[2]) <= speed_m_s
            and abs(w[0]) + abs(w[1]) + abs(w[2]) <= spin_rad_s
        )

    def touches(self, other: Body) -> bool:
        """Whether the two bodies are in contact, as of the last step."""
        return is_any_within(contacts(self.client, self.id, other.id))

    def bounding_box(self) -> tuple[Vector, Vector]:
        """Return the lower and upper corner of the axis-aligned bounding box."""
        return pybullet.getAABB(self.id, physicsClientId=self.client)


def world_vertices(body: Body) -> np.ndarray:
    """Return the vertices of a body's surface as it lies, [V, 3] in metres."""
    return body.pose.apply(body.shape.vertices)


def vertical_extent(body: Body) -> tuple[float, float]:
    """Return the heights of a body's lowest and highest point, as it lies, in metres."""
    heights = world_vertices(body)[:, 2]
    return float(heights.min()), float(heights.max())


def radius_m(body: Body) -> float:
    """Return the distance of the farthest point of an upright body from its axis."""
    low, high = body.shape.bounds_m
    return math.hypot(*(max(-a, b) for a, b in zip(low[:2], high[:2], strict=True)))
