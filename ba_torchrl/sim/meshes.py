"""Procedural triangle meshes; every face is counter-clockwise seen from outside."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np


class Mesh(NamedTuple):
    """A triangle mesh in its body's frame."""

    vertices: np.ndarray
    """[V, 3] float64, metres."""
    faces: np.ndarray
    """[F, 3] int64 indices into the vertices."""


def box_mesh(size_m: tuple[float, float, float]) -> Mesh:
    """Return a box centred on the origin."""
    corners = np.array(
        [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
    ) * np.asarray(size_m)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [tri for a, b, c, d in quads for tri in ((a, b, c), (a, c, d))]
    return Mesh(corners, np.array(faces, dtype=np.int64))


def moved(mesh: Mesh, offset_m: tuple[float, float, float], yaw_rad: float = 0.0) -> Mesh:
    """Return the mesh turned about z, then shifted."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return Mesh(mesh.vertices @ turn.T + np.asarray(offset_m), mesh.faces)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Return several meshes as one."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + n for mesh, n in zip(meshes, starts, strict=False)]),
    )


def write_obj(path: Path, parts: Sequence[Mesh]) -> None:
    """Write meshes into one Wavefront OBJ file, an object each.

    Args:
        path: the file.
        parts: metres become the file's units.
    """
    lines, start = [], 1
    for number, (vertices, faces) in enumerate(parts):
        lines.append(f"o part{number}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + start).tolist()]
        start += len(vertices)
    path.write_text("\n".join(lines) + "\n")
