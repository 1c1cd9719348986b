"""Body: a rigid body of a world; and the shapes that the tasks are made of."""

from __future__ import annotations

import math
import tempfile
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

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
from ba_torchrl.sim.meshes import Mesh, box_mesh, joined, write_obj

Color = tuple[float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class Shape(ABC):
    """Geometry and material of a body.

    Args:
        mass_kg: 0 for a static body.
        friction: lateral friction coefficient.
        color: red, green, blue, alpha in [0, 1].
        center_of_mass_m: in the frame of the geometry.
    """

    mass_kg: float = 0.1
    friction: float = 1.0
    color: Color = (0.8, 0.2, 0.2, 1.0)
    center_of_mass_m: Vector = (0.0, 0.0, 0.0)

    collision_margin_m: ClassVar[float | None] = None
    """Gap that PyBullet keeps around the geometry; None leaves its own choice."""

    @abstractmethod
    def mesh(self) -> Mesh:
        """Return the surface that the depth camera sees."""

    @abstractmethod
    def create_collision(self, client: int) -> int:
        """Create PyBullet's collision shape and return its id."""

    @abstractmethod
    def create_visual(self, client: int) -> int:
        """Create PyBullet's visual shape and return its id."""

    @cached_property
    def vertices(self) -> np.ndarray:
        """Vertices of the surface that the depth camera sees, [V, 3] in metres."""
        return self.mesh().vertices

    @cached_property
    def bounds_m(self) -> tuple[Vector, Vector]:
        """Lower and upper corner of the geometry in its own frame."""
        vertices = self.vertices
        return tuple(map(float, vertices.min(axis=0))), tuple(map(float, vertices.max(axis=0)))

    @property
    def height_m(self) -> float:
        """Height of the body in its upright pose."""
        low, high = self.bounds_m
        return high[2] - low[2]


@dataclass(frozen=True, kw_only=True)
class Box(Shape):
    """A box of the given edge lengths."""

    size_m: Vector

    def mesh(self) -> Mesh:
        """Return the box's surface."""
        return box_mesh(self.size_m)

    def create_collision(self, client: int) -> int:
        """Create the collision box."""
        return pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=[s / 2 for s in self.size_m], physicsClientId=client
        )

    def create_visual(self, client: int) -> int:
        """Create the visible box."""
        return pybullet.createVisualShape(
            pybullet.GEOM_BOX,
            halfExtents=[s / 2 for s in self.size_m],
            rgbaColor=self.color,
            physicsClientId=client,
        )


@dataclass(frozen=True, kw_only=True)
class Decal(Box):
    """A thin coloured sheet without collision, such as a goal area on the floor.

    Args:
        depth_m: how much lower than the floor the depth camera shows it.
    """

    depth_m: float = 0.0
    mass_kg: float = 0.0

    def create_collision(self, client: int) -> int:
        """A decal collides with nothing."""
        return -1


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid(Shape):
    """A body of convex parts, hollow where they leave a gap.

    Collisions see the convex hull of each part.

    Args:
        parts: their surfaces, in the common frame.
        surface: what cameras see; the parts unless given.
    """

    parts: tuple[Mesh, ...]
    surface: Mesh | None = None

    # PyBullet's millimetre stands outside a hull: stacks would float
    collision_margin_m: ClassVar[float | None] = 2e-4

    def mesh(self) -> Mesh:
        """Return what cameras see."""
        return joined(self.parts) if self.surface is None else self.surface

    def create_collision(self, client: int) -> int:
        """Create one hull for each part."""
        if len(self.parts) == 1:
            return pybullet.createCollisionShape(
                pybullet.GEOM_MESH,
                vertices=self.parts[0].vertices.tolist(),
                physicsClientId=client,
            )
        # PyBullet takes several hulls from a file only
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "parts.obj"
            write_obj(path, self.parts)
            return pybullet.createCollisionShape(
                pybullet.GEOM_MESH, fileName=str(path), physicsClientId=client
            )

    def create_visual(self, client: int) -> int:
        """Create the visible surface."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "surface.obj"
            write_obj(path, [self.mesh()])
            return pybullet.createVisualShape(
                pybullet.GEOM_MESH,
                fileName=str(path),
                rgbaColor=self.color,
                physicsClientId=client,
            )


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
