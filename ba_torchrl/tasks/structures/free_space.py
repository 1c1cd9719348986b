"""Free space on the ground: where a piece fits beside the others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body, footprint_radius_m, world_vertices
from ba_torchrl.tasks.terrain.flat import Terrain
from ba_torchrl.tasks.workspace import Area


class PlacementArea(NamedTuple):
    """The parts of the ground where pieces may be placed."""

    terrain: Terrain
    building: Area
    """Where structures stand."""
    aside: Area
    """Where other pieces are placed."""
    gap_m: float
    """Gap wanted between the bounding circles of two pieces."""
    line_yaw_rad: float | None = None
    """Direction of the line between the two supports of a bridge; None if it is free."""


def nearest_free_site(
    body: Body, others: Sequence[Body], area: PlacementArea, *, in_structure: bool
) -> tuple[float, float]:
    """Return where to place a body: the nearest site with the least deficit.

    Args:
        others: the bodies to keep a gap to.
        in_structure: whether the body is the base of a structure, instead of placed aside.
    """
    x, y, _ = body.position
    region = area.building if in_structure else area.aside
    sites = region.sites()
    distances = np.hypot(sites[:, 0] - x, sites[:, 1] - y)
    deficits = placement_deficit_m(sites, body, others, area, in_structure=in_structure)
    return tuple(sites[np.lexsort((distances, deficits))[0]].tolist())


def placement_deficit_m(
    sites: np.ndarray,
    body: Body,
    others: Sequence[Body],
    area: PlacementArea,
    *,
    in_structure: bool,
) -> np.ndarray:
    """Return the deficit of sites: the distance outside the area, plus the missing part of the gap.

    Args:
        sites: [S, 2] points of the ground, metres.
        others: the bodies to keep a gap to.
        in_structure: whether the body is part of a structure, instead of placed aside.

    Returns:
        [S] metres; zero for sites with enough free space.
    """
    radius_m = footprint_radius_m(body)
    if in_structure:
        outside = area.building.outside_m(sites) + area.terrain.overhang_m(sites, radius_m)
    else:
        outside = area.aside.outside_m(sites) + area.terrain.uneven_m(sites, radius_m)
    if not others:
        return outside
    centers = np.array([other.position[:2] for other in others])
    distances = np.hypot(*(sites[:, None] - centers).transpose(2, 0, 1))
    clearance = (distances - [footprint_radius_m(other) for other in others]).min(axis=1)
    return outside + np.maximum(area.gap_m + radius_m - clearance, 0.0)


def extent_along_m(body: Body, directions: np.ndarray) -> np.ndarray:
    """Return the extent [N] of a body from its origin along horizontal unit vectors [N, 2]."""
    return ((world_vertices(body)[:, :2] - body.position[:2]) @ directions.T).max(axis=0)
