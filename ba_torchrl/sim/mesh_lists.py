"""Meshes as the lists of numbers that PyBullet reads."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.meshes import Mesh


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
    """Return the lists of a mesh; those of equal meshes are the same objects.

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
