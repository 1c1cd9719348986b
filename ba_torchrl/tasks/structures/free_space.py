"""Free space on the ground: where a piece fits beside the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body, footprint_radius_m, vertical_extent, world_vertices
from ba_torchrl.sim.geometry import Vector

SITE_STEP_M = 0.02
"""Grid spacing of the sites that are compared."""


class PlacementArea(NamedTuple):
    """The area of the ground where pieces may be placed."""

    x: tuple[float, float]
    y: tuple[float, float]
    gap_m: float
    """Gap wanted between the bounding circles of two pieces."""
    height_m: Callable[[tuple[float, float]], float]
    """Height of the ground at a point, metres."""
    line_yaw_rad: float | None = None
    """Direction of the line between the two supports of a bridge; None if it is free."""


def nearest_free_position(body: Body, others: Sequence[Body], area: PlacementArea) -> Vector:
    """Return where to place a body's origin: the nearest site with the least deficit.

    The body stands on the ground in its present orientation.

    Args:
        body: the body to place.
        others: the bodies to keep a gap to.
        area: where to place it.
    """
    x, y, z = body.position
    sites = np.array([(a, b) for a in _grid(*area.x) for b in _grid(*area.y)])
    distances = np.hypot(sites[:, 0] - x, sites[:, 1] - y)
    best = np.lexsort((distances, placement_deficit_m(sites, body, others, area)))[0]
    site = tuple(sites[best].tolist())
    return (*site, area.height_m(site) + z - vertical_extent(body)[0])


def placement_deficit_m(
    sites: np.ndarray, body: Body, others: Sequence[Body], area: PlacementArea
) -> np.ndarray:
    """Return the deficit of sites: the distance outside the area, plus the missing part of the gap.

    Args:
        sites: [S, 2] points of the ground, metres.
        body: the body to place.
        others: the bodies to keep a gap to.
        area: where to place it.

    Returns:
        [S] metres; zero for sites with enough free space.
    """
    low, high = np.array([area.x, area.y]).T
    outside = np.maximum(np.maximum(low - sites, sites - high), 0.0).max(axis=1)
    if not others:
        return outside
    centers = np.array([other.position[:2] for other in others])
    distances = np.hypot(*(sites[:, None] - centers).transpose(2, 0, 1))
    clearance = (distances - [footprint_radius_m(other) for other in others]).min(axis=1)
    return outside + np.maximum(area.gap_m + footprint_radius_m(body) - clearance, 0.0)


def extent_along_m(body: Body, directions: np.ndarray) -> np.ndarray:
    """Return the extent [N] of a body from its origin along horizontal unit vectors [N, 2]."""
    return ((world_vertices(body)[:, :2] - body.position[:2]) @ directions.T).max(axis=0)


def _grid(low: float, high: float) -> list[float]:
    count = max(1, round((high - low) / SITE_STEP_M))
    return [low + (high - low) * i / count for i in range(count + 1)]
