"""Shapes: the geometry and material that a body is created from."""

from __future__ import annotations

import tempfile
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import pybullet

from ba_torchrl.sim.geometry import Vector
from ba_torchrl.sim.meshes import Mesh, box_mesh, merge_meshes, write_obj

Color = tuple[float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class Shape(ABC):
    """Geometry, mass and material of a body.

    Args:
        mass_kg: 0 for a static body.
        friction: coefficient of lateral friction.
        color: red, green, blue, alpha in [0, 1].
        center_of_mass_m: in the frame of the geometry, metres.
    """

    mass_kg: float = 0.1
    friction: float = 1.0
    color: Color = (0.8, 0.2, 0.2, 1.0)
    center_of_mass_m: Vector = (0.0, 0.0, 0.0)

    collision_margin_m: ClassVar[float | None] = None
    """PyBullet's collision margin around the geometry; None keeps PyBullet's default."""

    @abstractmethod
    def mesh(self) -> Mesh:
        """Return the visual surface, in the frame of the geometry."""

    @abstractmethod
    def create_collision(self, client: int) -> int:
        """Create a PyBullet collision shape and return its id."""

    @abstractmethod
    def create_visual(self, client: int) -> int:
        """Create a PyBullet visual shape and return its id."""

    @cached_property
    def vertices(self) -> np.ndarray:
        """Vertices of the visual surface, [V, 3] metres."""
        return self.mesh().vertices

    @cached_property
    def bounds_m(self) -> tuple[Vector, Vector]:
        """Lower and upper corner of the bounding box in the frame of the geometry."""
        vertices = self.vertices
        return tuple(map(float, vertices.min(axis=0))), tuple(map(float, vertices.max(axis=0)))

    @property
    def height_m(self) -> float:
        """Height of the bounding box."""
        low, high = self.bounds_m
        return high[2] - low[2]


@dataclass(frozen=True, kw_only=True)
class Box(Shape):
    """A box with edge lengths along x, y and z, its centre at the origin."""

    size_m: Vector

    def mesh(self) -> Mesh:
        return box_mesh(self.size_m)

    def create_collision(self, client: int) -> int:
        return pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=[s / 2 for s in self.size_m], physicsClientId=client
        )

    def create_visual(self, client: int) -> int:
        return pybullet.createVisualShape(
            pybullet.GEOM_BOX,
            halfExtents=[s / 2 for s in self.size_m],
            rgbaColor=self.color,
            physicsClientId=client,
        )


@dataclass(frozen=True, kw_only=True)
class Decal(Box):
    """A thin coloured sheet without collision geometry, such as a goal area on the floor.

    Depth images show a recess of the depth ``recess_depth_m`` in the floor in its place.
    """

    recess_depth_m: float = 0.0
    mass_kg: float = 0.0

    def create_collision(self, client: int) -> int:
        """Return PyBullet's id for no collision shape."""
        return -1


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid(Shape):
    """A body that consists of convex parts in a common frame, so that it can be concave or hollow.

    The collision geometry is the convex hull of each part. Without a visual surface, the parts are
    visible.
    """

    parts: tuple[Mesh, ...]
    surface: Mesh | None = None

    # PyBullet's default margin of 1 mm lies outside a hull: stacked bodies would have visible gaps
    collision_margin_m: ClassVar[float | None] = 2e-4

    def mesh(self) -> Mesh:
        return merge_meshes(self.parts) if self.surface is None else self.surface

    def create_collision(self, client: int) -> int:
        """Create one convex hull for each part."""
        if len(self.parts) == 1:
            return pybullet.createCollisionShape(
                pybullet.GEOM_MESH,
                vertices=mesh_lists(self.parts[0]).vertices,
                physicsClientId=client,
            )
        # PyBullet creates several hulls only from a file
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mesh.obj"
            write_obj(path, self.parts)
            return pybullet.createCollisionShape(
                pybullet.GEOM_MESH, fileName=str(path), physicsClientId=client
            )

    def create_visual(self, client: int) -> int:
        lists = mesh_lists(self.mesh())
        return pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            vertices=lists.corners,
            normals=lists.normals,
            indices=lists.indices,
            rgbaColor=self.color,
            physicsClientId=client,
        )


class MeshLists(NamedTuple):
    """A triangle mesh for PyBullet, with flat shading."""

    vertices: list[list[float]]
    """Position of each vertex, [V][3] metres."""
    corners: list[list[float]]
    """Position of each corner of each face, [3 F][3] metres."""
    normals: list[list[float]]
    """Unit normal of the face of each corner, [3 F][3]; zero for a face without area."""
    indices: list[int]
    """The numbers of the corners, [3 F]."""


def mesh_lists(mesh: Mesh) -> MeshLists:
    """Return the lists of a mesh; equal meshes share the same lists.

    PyBullet never releases the vertices and normals that are passed to it, so that new lists for
    each world would fill the memory.
    """
    vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
    faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
    return _lists(vertices.tobytes(), faces.tobytes())


@cache
def _lists(vertex_data: bytes, face_data: bytes) -> MeshLists:
    vertices = np.frombuffer(vertex_data).reshape(-1, 3)
    faces = np.frombuffer(face_data, dtype=np.int64).reshape(-1, 3)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    shared = vertices.tolist()
    return MeshLists(
        vertices=shared,
        corners=[shared[vertex] for vertex in faces.ravel().tolist()],
        normals=[normal for normal in normals.tolist() for _ in range(3)],
        indices=list(range(faces.size)),
    )
