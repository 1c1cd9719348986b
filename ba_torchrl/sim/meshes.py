"""Triangle meshes, whose faces are counter-clockwise seen from outside, and OBJ files."""

from __future__ import annotations

import codecs
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np


class Mesh(NamedTuple):
    """A triangle mesh in the frame of its body."""

    vertices: np.ndarray
    """[V, 3] float64, metres."""
    faces: np.ndarray
    """[F, 3] int64 indices into the vertices."""


def box_mesh(size_m: tuple[float, float, float]) -> Mesh:
    """Return a box with edge lengths along x, y and z, centred at the origin."""
    corners = np.array(
        [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
    ) * np.asarray(size_m)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [tri for a, b, c, d in quads for tri in ((a, b, c), (a, c, d))]
    return Mesh(corners, np.array(faces, dtype=np.int64))


def transform_mesh(mesh: Mesh, offset_m: tuple[float, float, float], yaw_rad: float = 0.0) -> Mesh:
    """Return the mesh, rotated about the z axis and then translated."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return Mesh(mesh.vertices @ rotation.T + np.asarray(offset_m), mesh.faces)


def merge_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Return one mesh with the vertices and faces of several."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + n for mesh, n in zip(meshes, starts, strict=False)]),
    )


def write_obj(path: Path, parts: Sequence[Mesh]) -> None:
    """Write a Wavefront OBJ file, whose unit is the metre, with one object for each mesh."""
    lines, start = [], 1
    for number, (vertices, faces) in enumerate(parts):
        lines.append(f"o part{number}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + start).tolist()]
        start += len(vertices)
    path.write_text("\n".join(lines) + "\n")


def read_obj(content: bytes) -> list[Mesh]:
    """Return the polygons of a Wavefront OBJ file as triangles, one mesh for each of its objects.

    Texture coordinates, normals, colours, materials and groups have no effect; each mesh holds the
    vertices that its faces use, in their order.

    Raises:
        ValueError: a vertex or a face cannot be read.
    """
    lines = iter(content.removeprefix(codecs.BOM_UTF8).splitlines())
    vertices: list[list[float]] = []
    objects: list[list[list[int]]] = [[]]
    for line in lines:
        while line.rstrip().endswith(b"\\") and line.lstrip()[:1] in b"vVfF":
            line = line.rstrip()[:-1] + b" " + next(lines, b"")  # a backslash continues a line
        kind, *values = line.split(b"#")[0].split() or [b""]
        try:
            match kind.lower():
                case b"v":
                    x, y, z = map(float, values[:3])
                    vertices.append([x, y, z])
                case b"f":
                    objects[-1].append(_obj_corners(values, len(vertices)))
                case b"o":
                    objects.append([])
        except ValueError as error:
            raise ValueError(f"{line.decode(errors='replace').strip()!r}: {error}") from None
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    highest = max((corner for polygons in objects for p in polygons for corner in p), default=-1)
    if highest >= len(points):
        raise ValueError(f"a face uses vertex {highest + 1} of {len(points)}")
    meshes = []
    for polygons in filter(None, objects):
        used, faces = np.unique(_triangles(points, polygons), return_inverse=True)
        meshes.append(Mesh(points[used], faces.reshape(-1, 3).astype(np.int64)))
    return meshes


def polygon_triangles(corners: np.ndarray) -> list[tuple[int, int, int]]:
    """Return triangles that fill a polygon, which need not be convex, by clipping its ears.

    The corners [N, 3] are approximately in a plane. The N - 2 triples of their indices have the
    orientation of the polygon.
    """
    from_first = corners - corners[0]
    normal = np.cross(from_first, np.roll(from_first, -1, axis=0)).sum(axis=0)
    drop = int(np.abs(normal).argmax())  # the polygon is projected along this axis
    plane = from_first[:, [(drop + 1) % 3, (drop + 2) % 3]] * [1.0, np.sign(normal[drop]) or 1.0]
    left, triangles, k = list(range(len(corners))), [], 1
    tried = 0
    while len(left) > 3 and tried < len(left):
        k %= len(left)
        a, b, c = left[k - 1], left[k], left[(k + 1) % len(left)]
        if _is_ear(plane[[a, b, c]], plane[left]):
            triangles.append((a, b, c))
            del left[k]
            tried = 0
        else:
            k, tried = k + 1, tried + 1
    # what remains is a triangle, or crosses itself
    return triangles + [(left[0], b, c) for b, c in pairwise(left[1:])]


def gable_mesh(size_m: tuple[float, float, float], eaves_m: float = 0.0) -> Mesh:
    """Return a gable roof with its ridge along y, its bounding box centred at the origin.

    Args:
        size_m: extents along x (perpendicular to the ridge), y (along the ridge) and z.
        eaves_m: height of the vertical sides below the slopes, which fingers can grasp.
    """
    x, y, z = (extent / 2 for extent in size_m)
    end = [(-x, -z), (x, -z), (0.0, z)]
    if eaves_m > 0:
        end = [(-x, -z), (x, -z), (x, eaves_m - z), (0.0, z), (-x, eaves_m - z)]
    prism = prism_mesh(end, -y, y)  # along z, which is rotated to -y
    corners = prism.vertices
    return Mesh(np.stack([corners[:, 0], -corners[:, 2], corners[:, 1]], axis=1), prism.faces)


def rod_mesh(length_m: float, diameter_m: float, sides: int = 16) -> Mesh:
    """Return a cylinder along y, centred at the origin, with a regular polygon as cross-section.

    ``diameter_m`` belongs to the polygon's circumscribed circle.
    """
    angles = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.sin(angles), np.zeros(sides), np.cos(angles)], axis=1) * diameter_m / 2
    half = np.array([0.0, length_m / 2, 0.0])
    corner, following = np.arange(sides), np.roll(np.arange(sides), -1)
    faces = [
        *np.stack([corner, following + sides, corner + sides], axis=1),
        *np.stack([corner, following, following + sides], axis=1),
        *np.stack([np.zeros(sides - 2, int), corner[2:], corner[1:-1]], axis=1),
        *np.stack([np.zeros(sides - 2, int), corner[1:-1], corner[2:]], axis=1) + sides,
    ]
    return Mesh(np.concatenate([ring - half, ring + half]), np.array(faces, dtype=np.int64))


def prism_mesh(corners_m: Sequence[tuple[float, float]], low_m: float, high_m: float) -> Mesh:
    """Return a prism along z.

    The x and y of the corners of its convex base are counter-clockwise.
    """
    count = len(corners_m)
    vertices = [(x, y, z) for z in (low_m, high_m) for x, y in corners_m]
    return Mesh(np.array(vertices, dtype=np.float64), _prism_faces(count))


def ring_parts(section_m: Sequence[tuple[float, float]], segments: int) -> list[Mesh]:
    """Return a ring about the z axis as convex segments.

    The corners of the convex cross-section are counter-clockwise in the plane of radius (first
    axis) and height (second axis).
    """
    angles = np.arange(segments + 1) * (2 * np.pi / segments)
    ends = [
        np.array([(r * np.cos(angle), r * np.sin(angle), z) for r, z in section_m])
        for angle in angles
    ]
    # a positive rotation sweeps the section along its negative normal
    faces = _prism_faces(len(section_m))[:, ::-1]
    return [Mesh(np.concatenate(pair), faces) for pair in pairwise(ends)]


def bowl_parts(
    radius_m: float,
    height_m: float,
    *,
    foot_radius_m: float,
    floor_m: float,
    wall_m: float,
    segments: int = 16,
) -> list[Mesh]:
    """Return an open bowl as convex parts, its bounding box centred at the origin.

    The bowl has a round foot and a conical wall above it. Only the foot touches the support
    surface: contacts of every wall segment would slow down the simulation.

    Args:
        radius_m: outer radius of the rim.
        foot_radius_m: radius of the foot.
        floor_m: thickness of the foot, whose upper face is the floor of the bowl.
        wall_m: horizontal thickness of the wall.
        segments: number of wall segments and of sides of the foot.
    """
    inner = foot_radius_m - wall_m / 2
    wall = [
        (inner, floor_m),
        (inner + wall_m, floor_m),
        (radius_m, height_m),
        (radius_m - wall_m, height_m),
    ]
    angles = np.arange(segments) * (2 * np.pi / segments)
    circle = [(foot_radius_m * np.cos(a), foot_radius_m * np.sin(a)) for a in angles]
    parts = [prism_mesh(circle, 0.0, floor_m), *ring_parts(wall, segments)]
    return [transform_mesh(part, (0.0, 0.0, -height_m / 2)) for part in parts]


def centroid(parts: Sequence[Mesh]) -> tuple[float, float, float]:
    """Return the centre of mass of closed, disjoint meshes of uniform density, metres."""
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in parts])  # [F, 3 corners, 3]
    # signed tetrahedra between the origin and each triangle
    volumes = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    center = (volumes[:, None] * corners.sum(axis=1) / 4).sum(axis=0) / volumes.sum()
    return tuple(center.tolist())


def _obj_corners(values: Sequence[bytes], num_vertices: int) -> list[int]:
    """Return the vertex indices of a face, from 0.

    OBJ writes a corner as an index from 1, or a negative one that counts back from the last vertex
    read so far, with or without a texture coordinate and a normal.
    """
    if len(values) < 3:
        raise ValueError("a face needs three corners")
    numbers = [int(value.split(b"/")[0]) for value in values]
    corners = [n + num_vertices if n < 0 else n - 1 for n in numbers]
    if 0 in numbers or min(corners) < 0:
        raise ValueError("there is no such vertex")
    return corners


def _triangles(points: np.ndarray, polygons: Sequence[Sequence[int]]) -> np.ndarray:
    """Return triangles [F, 3] that fill polygons, in the order of the polygons."""
    quads = [i for i, polygon in enumerate(polygons) if len(polygon) == 4]
    corners = points[np.array([polygons[i] for i in quads], dtype=np.int64).reshape(-1, 4)]
    with np.errstate(invalid="ignore"):  # coordinates may be infinite
        edges = corners - corners[:, :1]
        halves = np.cross(edges[:, 1:3], edges[:, 2:4])  # normals on both sides of the diagonal
        is_inside = (halves[:, 0] * halves[:, 1]).sum(axis=1) > 0
        ordinary = {i for i, inside in zip(quads, is_inside.tolist(), strict=True) if inside}
        faces: list[tuple[int, ...]] = []
        for i, polygon in enumerate(polygons):
            if len(polygon) == 3 or i in ordinary:
                faces += [(polygon[0], b, c) for b, c in pairwise(polygon[1:])]
            else:
                triangles = polygon_triangles(points[list(polygon)])
                faces += [tuple(polygon[k] for k in triangle) for triangle in triangles]
    return np.array(faces, dtype=np.int64)


def _is_ear(corners: np.ndarray, polygon: np.ndarray) -> bool:
    """Return whether a triangle of successive corners of a polygon contains no other corner.

    The polygon [N, 2] is counter-clockwise.
    """
    edges = np.roll(corners, -1, axis=0) - corners
    if edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0] <= 0:
        return False
    to_points = polygon[:, None] - corners
    sides = edges[:, 0] * to_points[..., 1] - edges[:, 1] * to_points[..., 0]  # [N, 3]
    inside = (sides >= 0).all(axis=1)
    is_corner = (to_points == 0).all(axis=2).any(axis=1)  # also of equal position
    return not (inside & ~is_corner).any()


def _prism_faces(count: int) -> np.ndarray:
    """Return the faces of a prism whose first vertices are the corners of the base.

    Those of the upper face follow.
    """
    caps = [(0, i + 1, i) for i in range(1, count - 1)]
    caps += [(count, count + i, count + i + 1) for i in range(1, count - 1)]
    sides = []
    for i in range(count):
        j = (i + 1) % count
        sides += [(i, j, count + j), (i, count + j, count + i)]
    return np.array(caps + sides, dtype=np.int64)


def frame_parts(size_m: tuple[float, float, float], wall_m: float) -> list[Mesh]:
    """Return four vertical walls around a rectangle, their bounding box centred at the origin.

    ``size_m`` has the outer extents along x, y and z.
    """
    x, y, z = size_m
    along_x, along_y = box_mesh((x - 2 * wall_m, wall_m, z)), box_mesh((wall_m, y, z))
    parts = []
    for side in (-0.5, 0.5):
        parts.append(transform_mesh(along_x, (0.0, side * (y - wall_m), 0.0)))
        parts.append(transform_mesh(along_y, (side * (x - wall_m), 0.0, 0.0)))
    return parts


def lathe_parts(profile_m: Sequence[tuple[float, float]], sides: int = 16) -> list[Mesh]:
    """Return a solid of revolution about the z axis as convex parts, one above the other.

    The profile has radius and height of its corners, from the bottom to the top. Polygons with a
    number of sides approximate circles.
    """
    angles = 2 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return [
        Mesh(
            np.concatenate(
                [np.column_stack([radius * circle, np.full(sides, z)]) for radius, z in ends]
            ),
            _prism_faces(sides),
        )
        for ends in pairwise(profile_m)
    ]
