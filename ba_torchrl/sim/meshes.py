"""Procedural triangle meshes; every face is counter-clockwise seen from outside."""

from __future__ import annotations

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
