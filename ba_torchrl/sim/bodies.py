"""Body: a rigid body of a world, and measurements of its surface at its current pose."""

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
        shape: geometry, mass and material.
        name: used in error messages.
    """

    _vertices: tuple[Pose, np.ndarray] | None = None
    """Pose and result of the last call of `world_vertices`."""

    def __init__(self, client: int, shape: Shape, name: str) -> None:
        self.client = client
        self.shape = shape
        self.name = name
        self.is_hidden = False
        """Whether cameras and `World.is_still` ignore the body."""
        # PyBullet reports and sets the pose of the centre of mass
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
            frictionAnchor=1,  # prevents slow sliding of held and stacked bodies
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
        """Whether the body moves freely in six dimensions, so that a gripper can lift it."""
        return not self.is_static

    @property
    def pose(self) -> Pose:
        """Pose of the frame of the geometry in the world."""
        pose = Pose(*pybullet.getBasePositionAndOrientation(self.id, physicsClientId=self.client))
        return pose if self._from_center is None else bullet_compose(pose, self._from_center)

    @property
    def position(self) -> Vector:
        """Position of the frame of the geometry, metres."""
        return self.pose.position

    @property
    def yaw_rad(self) -> float:
        """Heading of the body's x axis in the horizontal plane."""
        return self.pose.yaw_rad

    @property
    def tilt_rad(self) -> float:
        """Angle between the body's z axis and the vertical."""
        return quaternion_tilt(self.pose.orientation)

    def place(self, position: Vector, yaw_rad: float = 0.0) -> None:
        """Teleport the body to an upright pose and set its velocity to zero.

        Args:
            position: of the frame of the geometry, metres.
            yaw_rad: heading of the body's x axis.
        """
        self.set_pose(position, yaw_quaternion(yaw_rad))

    def set_pose(self, position: Vector, orientation: Quaternion) -> None:
        """Teleport the body to a pose and set its velocity to zero.

        Args:
            position: of the frame of the geometry, metres.
            orientation: unit quaternion (x, y, z, w).
        """
        if self._center is not None:
            position, orientation = bullet_compose(Pose(position, orientation), self._center)
        pybullet.resetBasePositionAndOrientation(
            self.id, position, orientation, physicsClientId=self.client
        )
        pybullet.resetBaseVelocity(
            self.id, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), physicsClientId=self.client
        )

    def is_still(self, speed_m_s: float, spin_rad_s: float) -> bool:
        """Whether the velocities are within limits.

        Args:
            speed_m_s: limit of the L1 norm of the linear velocity.
            spin_rad_s: limit of the L1 norm of the angular velocity.
        """
        v, w = pybullet.getBaseVelocity(self.id, physicsClientId=self.client)
        return (
            abs(v[0]) + abs(v[1]) + abs(v[2]) <= speed_m_s
            and abs(w[0]) + abs(w[1]) + abs(w[2]) <= spin_rad_s
        )

    def touches(self, other: Body) -> bool:
        """Whether the two bodies were in contact in the last physics step."""
        return is_any_within(contacts(self.client, self.id, other.id))

    def bounding_box(self) -> tuple[Vector, Vector]:
        """Return the lower and upper corner of the axis-aligned bounding box, metres.

        It contains the surface exactly; PyBullet's is larger by up to 35 mm for a rotated body.
        """
        vertices = world_vertices(self)
        return tuple(vertices.min(axis=0).tolist()), tuple(vertices.max(axis=0).tolist())


def world_vertices(body: Body) -> np.ndarray:
    """Return the vertices of a body's visual surface in the world frame, [V, 3] metres."""
    pose = body.pose
    if body._vertices is None or body._vertices[0] != pose:
        vertices = pose.apply(body.shape.vertices)
        vertices.flags.writeable = False
        body._vertices = pose, vertices
    return body._vertices[1]


def vertical_extent(body: Body) -> tuple[float, float]:
    """Return the heights of a body's lowest and highest vertex in the world frame, metres."""
    heights = world_vertices(body)[:, 2]
    return float(heights.min()), float(heights.max())


def footprint_radius_m(body: Body) -> float:
    """Return the largest horizontal distance of an upright body's bounding box from its origin."""
    low, high = body.shape.bounds_m
    return math.hypot(*(max(-a, b) for a, b in zip(low[:2], high[:2], strict=True)))
