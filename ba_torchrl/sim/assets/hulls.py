"""Convex hulls: what PyBullet collides is what the cameras see, so objects are made of them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.meshes import Mesh

STABILITY_MARGIN_M = 2e-3
"""A body rests on a facet if its centre of mass is this far inside it."""
FACET_TOLERANCE_M = 1e-3
"""Facets that bulge less than this count as flat: a body rocks on them, and stays."""
SAME_POSE_COSINE = math.cos(math.radians(10))
NUM_SAMPLES = 2000
FINGER_HALF_WIDTH_M = 0.0125
MAX_GAP_M = 0.066
"""Open fingers take no more, with some room to either side."""
GRASP_Z_M = (0.004, 0.04)
"""Heights above the ground that fingers cover."""


class StablePose(NamedTuple):
    """A pose in which a convex body lies still."""

    height_m: float
    width_m: float
    """Of the narrowest gap between two vertical walls that the body fits into."""
    antipodal_score: float
    """How nearly opposite the surfaces are that two closing fingers meet, and how nearly across
    the line on which they close, for the best line: 1 for parallel upright sides, less for the
    sides of a wedge."""
    turn: np.ndarray
    """[3, 3] rotation into this pose, with that direction along x."""


def convex_hull(points: np.ndarray) -> Mesh:
    """Return the convex hull of points [N, 3], metres.

    Raises:
        ValueError: the points are not finite, or all in one plane.
    """
    from scipy.spatial import ConvexHull, QhullError  # a third of a second, so only if needed

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


def volume_and_center(mesh: Mesh) -> tuple[float, np.ndarray]:
    """Return the volume (cubic metres) of a closed surface and the centroid [3] of its inside."""
    origin = mesh.vertices.mean(axis=0)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] - origin for i in range(3))
    volumes = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    total = float(volumes.sum())
    return total, origin + (volumes[:, None] * (a + b + c)).sum(axis=0) / (4 * total)


def stable_poses(hull: Mesh) -> list[StablePose]:
    """Return the poses in which a convex body of even density lies still, one per facet."""
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
            # the plane's axes in this order, with the height, make a right-handed frame
            axes = _axes(normal)[:, ::-1]
            standing = np.column_stack([hull.vertices @ axes, heights - heights.min()])
            antipodal_score, yaw = _antipodal_score(Mesh(standing, hull.faces), center @ axes)
            cos, sin = math.cos(yaw), math.sin(yaw)
            turn = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
            turn = turn @ np.column_stack([axes, -normal]).T
            width = narrowest_width(plane)
            found.append(StablePose(float(np.ptp(heights)), width, antipodal_score, turn))
            normals = np.vstack([normals, normal])
    return found


def surface_samples(mesh: Mesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points [count, 3] spread evenly over a surface, and the outer normals there.

    They follow from the surface alone: the same points every time.
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
    """Return the least distance of two parallel lines that hold points [N, 2] between them."""
    turns = np.linspace(0, np.pi, 90, endpoint=False)
    axes = np.stack([np.cos(turns), np.sin(turns)])
    return float(np.ptp(points @ axes, axis=0).min())


def _antipodal_score(standing: Mesh, center_xy: np.ndarray) -> tuple[float, float]:
    """Return `Rest.antipodal_score` of a body that stands on z = 0, and the yaw of its direction."""
    points, normals = surface_samples(standing, NUM_SAMPLES)
    low, high = GRASP_Z_M
    best = (0.0, 0.0)
    for turn in np.linspace(0, np.pi, 24, endpoint=False).tolist():
        axis = np.array([math.cos(turn), math.sin(turn)])
        along = (points[:, :2] - center_xy) @ axis
        across = (points[:, :2] - center_xy) @ np.array([-axis[1], axis[0]])
        met = (np.abs(across) < FINGER_HALF_WIDTH_M) & (points[:, 2] > low) & (points[:, 2] < high)
        if not met.any() or np.ptp(along[met]) > MAX_GAP_M:
            continue
        left, right = along[met] < along[met].min() + 2e-3, along[met] > along[met].max() - 2e-3
        first, second = (normals[met][side].mean(axis=0) for side in (left, right))
        facing = min(-float(first[:2] @ axis), float(second[:2] @ axis))
        best = max(best, (-float(first @ second) * max(facing, 0.0), turn))
    return best


def _axes(normal: np.ndarray) -> np.ndarray:
    """Return two axes [3, 2] across ``normal``, which follows them in a right-handed frame."""
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    u = np.cross(normal, helper)
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(normal, u)], axis=1)


def _depth_inside(points: np.ndarray, target: np.ndarray) -> float:
    """Return how far ``target`` [2] lies inside the hull of points [N, 2]; negative outside."""
    turns = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    axes = np.stack([np.cos(turns), np.sin(turns)])
    return float(((points @ axes).max(axis=0) - target @ axes).min())
