"""Convex hulls and their stable poses."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.meshes import Mesh

STABILITY_MARGIN_M = 2e-3
"""A facet is stable if the projected centre of mass is at least this far from its border."""
FACET_TOLERANCE_M = 1e-3
"""Vertices within this distance of the support plane belong to the facet."""
SAME_POSE_COSINE = math.cos(math.radians(10))
"""Facets whose normals differ by less than this angle count as one stable pose."""
MAX_HULL_VERTICES = 256
"""A hull with more vertices is simplified."""
HULL_ERROR = (1e-3, 1e-2)
"""Distances from a simplified hull, in lengths of the hull: vertices that are nearer than the first
are left out, and more than `MAX_HULL_VERTICES` are used until none is farther than the second."""
NUM_DIRECTIONS = 192
"""Directions in which a simplified hull first has the support points of the hull."""
NUM_SAMPLES = 2000
FINGER_HALF_WIDTH_M = 0.0125
MAX_GAP_M = 0.066
"""Largest object width between the open fingers, with clearance on both sides."""
GRASP_Z_M = (0.004, 0.04)
"""Range of heights above the support surface that the fingers cover in a grasp."""


class StablePose(NamedTuple):
    """A stable resting pose of a convex body on a horizontal surface."""

    height_m: float
    width_m: float
    """Smallest distance of two parallel vertical planes that enclose the body."""
    antipodal_score: float
    """Quality of the best top-down antipodal grasp, in [0, 1]: 1 if the contact normals of the two
    fingers are opposite and parallel to the grasp axis, less for the sides of a wedge."""
    rotation: np.ndarray
    """[3, 3] rotation into this pose, with the axis of that grasp along x."""


def convex_hull(points: np.ndarray) -> Mesh:
    """Return the convex hull of points [N, 3], metres.

    Raises:
        ValueError: the points are not finite, or coplanar.
    """
    from scipy.spatial import ConvexHull, QhullError  # imported here: it takes a third of a second

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise ValueError(f"no convex hull of {len(points)} points: {reason}") from None
    used, faces = np.unique(hull.simplices, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int64)
    vertices = np.asarray(points, dtype=np.float64)[used]
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    inwards = np.einsum("fi,fi->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return Mesh(vertices, faces)


def simplified_hull(hull: Mesh) -> Mesh:
    """Return the hull of a selection of a hull's vertices, so that contacts are computed quickly.

    The vertices that are left out lie at most 1 % of the hull's length outside of the facets of the
    result (0.8 % for a ball with 30,000 vertices, 0.03 % for a cylinder). A hull with at most
    `MAX_HULL_VERTICES` vertices is returned as it is.
    """
    if len(hull.vertices) <= MAX_HULL_VERTICES:
        return hull
    least, most = np.array(HULL_ERROR) * np.ptp(hull.vertices, axis=0).max()
    number = np.arange(NUM_DIRECTIONS) + 0.5
    z, turn = 1 - 2 * number / NUM_DIRECTIONS, number * np.pi * (3 - 5**0.5)
    radius = np.sqrt(1 - z * z)  # a spiral on the unit sphere
    spiral = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), z])
    directions = np.vstack([np.eye(3), -np.eye(3), spiral])
    left = hull.vertices
    chosen = left[np.unique((left @ directions.T).argmax(axis=0))]
    while True:
        inner = convex_hull(chosen)
        a, b, c = (inner.vertices[inner.faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
        facets, errors = _most_outside(left, normals, np.einsum("fi,fi->f", normals, a))
        farthest, room = errors.max(), MAX_HULL_VERTICES - len(chosen)
        if farthest <= least or (room <= 0 and farthest <= most):
            return inner
        # the farthest vertex of each facet, unless others are much farther
        order = np.argsort(-errors, kind="stable")
        order = order[np.sort(np.unique(facets[order], return_index=True)[1])]
        order = order[errors[order] > 0.7 * farthest]
        chosen = np.vstack([chosen, left[order[: max(room, 1)]]])
        left = left[errors > least]


def volume_and_center(mesh: Mesh) -> tuple[float, np.ndarray]:
    """Return the volume (cubic metres) and the centroid [3] of the solid inside a closed mesh."""
    origin = mesh.vertices.mean(axis=0)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] - origin for i in range(3))
    volumes = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    total = float(volumes.sum())
    return total, origin + (volumes[:, None] * (a + b + c)).sum(axis=0) / (4 * total)


def stable_poses(hull: Mesh) -> list[StablePose]:
    """Return the stable poses of a convex body of uniform density, one for each stable facet."""
    center = volume_and_center(hull)[1]
    found: list[StablePose] = []
    normals = np.empty((0, 3))
    a, b, c = (hull.vertices[hull.faces[:, i]] for i in range(3))
    crosses = np.cross(b - a, c - a)
    areas = np.linalg.norm(crosses, axis=1)
    for i in np.argsort(-areas, kind="stable"):
        normal = crosses[i] / areas[i]
        if (normals @ normal > SAME_POSE_COSINE).any():
            continue
        heights = hull.vertices @ -normal
        plane = hull.vertices @ _axes(normal)
        facet = plane[heights < heights.min() + FACET_TOLERANCE_M]
        if _depth_inside(facet, center @ _axes(normal)) >= STABILITY_MARGIN_M:
            # in this order, the two axes and the upward direction form a right-handed frame
            axes = _axes(normal)[:, ::-1]
            resting = np.column_stack([hull.vertices @ axes, heights - heights.min()])
            score, yaw = _antipodal_score(Mesh(resting, hull.faces), center @ axes)
            cos, sin = math.cos(yaw), math.sin(yaw)
            rotation = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
            rotation = rotation @ np.column_stack([axes, -normal]).T
            width = narrowest_width(plane)
            found.append(StablePose(float(np.ptp(heights)), width, score, rotation))
            normals = np.vstack([normals, normal])
    return found


def surface_samples(mesh: Mesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points [count, 3] of a uniform density on a surface, and their outward normals.

    The result is deterministic: the same mesh gives the same points.
    """
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    crosses = np.cross(b - a, c - a)
    areas = np.linalg.norm(crosses, axis=1)
    shares = areas.cumsum() / areas.sum()
    chosen = np.searchsorted(shares, (np.arange(count) + 0.5) / count)
    u, v = np.random.default_rng(0).random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    points = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    return points, crosses[chosen] / areas[chosen, None]


def narrowest_width(points: np.ndarray) -> float:
    """Return the smallest distance of two parallel lines that enclose points [N, 2], metres."""
    angles = np.linspace(0, np.pi, 90, endpoint=False)
    axes = np.stack([np.cos(angles), np.sin(angles)])
    return float(np.ptp(points @ axes, axis=0).min())


def _antipodal_score(resting: Mesh, center_xy: np.ndarray) -> tuple[float, float]:
    """Return `StablePose.antipodal_score` and the yaw of the best grasp axis.

    The body rests on the plane z = 0 with its centre of mass above ``center_xy``.
    """
    points, normals = surface_samples(resting, NUM_SAMPLES)
    low, high = GRASP_Z_M
    best = (0.0, 0.0)
    for yaw in np.linspace(0, np.pi, 24, endpoint=False).tolist():
        axis = np.array([math.cos(yaw), math.sin(yaw)])
        along = (points[:, :2] - center_xy) @ axis
        across = (points[:, :2] - center_xy) @ np.array([-axis[1], axis[0]])
        between = np.abs(across) < FINGER_HALF_WIDTH_M
        between &= (points[:, 2] > low) & (points[:, 2] < high)
        if not between.any() or np.ptp(along[between]) > MAX_GAP_M:
            continue
        along, normals_between = along[between], normals[between]
        left, right = along < along.min() + 2e-3, along > along.max() - 2e-3
        first, second = (normals_between[side].mean(axis=0) for side in (left, right))
        alignment = min(-float(first[:2] @ axis), float(second[:2] @ axis))
        best = max(best, (-float(first @ second) * max(alignment, 0.0), yaw))
    return best


def _most_outside(
    points: np.ndarray, normals: np.ndarray, offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return for each point the facet it is farthest outside of, and its distance from the plane.

    A facet has an outward normal [F, 3] and the distance [F] of its plane from the origin.
    """
    facets, distances = [], []
    for block in np.array_split(points, len(points) // 10_000 + 1):  # bounds the memory
        outside = block @ normals.T - offsets
        facets.append(outside.argmax(axis=1))
        distances.append(outside.max(axis=1))
    return np.concatenate(facets), np.concatenate(distances)


def _axes(normal: np.ndarray) -> np.ndarray:
    """Return two columns [3, 2] that form a right-handed frame with ``normal`` as the third."""
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    u = np.cross(normal, helper)
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(normal, u)], axis=1)


def _depth_inside(points: np.ndarray, target: np.ndarray) -> float:
    """Return the distance of ``target`` [2] to the border of the convex hull of points [N, 2].

    It is negative outside of the hull.
    """
    angles = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    axes = np.stack([np.cos(angles), np.sin(angles)])
    return float(((points @ axes).max(axis=0) - target @ axes).min())
