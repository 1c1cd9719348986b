"""Shapes: the geometry and material that a body is created from."""

from __future__ import annotations

import tempfile
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
import pybullet

from ba_torchrl.sim.geometry import Vector
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
