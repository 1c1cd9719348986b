"""Room on the ground: for a piece beside others, and for fingers beside a piece."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body, footprint_radius_m, vertical_extent, world_vertices
from ba_torchrl.sim.geometry import Vector

SPOT_STEP_M = 0.02
"""Spots are looked for in steps of this length."""


class PlacementArea(NamedTuple):
    """Where on the ground pieces may be put."""

    x: tuple[float, float]
    y: tuple[float, float]
    gap_m: float
    """Room wanted around a piece."""
    height_m: Callable[[tuple[float, float]], float]
    """Height of the ground at a point, metres."""
    line_yaw_rad: float | None = None
    """Direction in which two pieces for a bridge must stand; None if any will do."""


def nearest_spot(body: Body, others: Sequence[Body], area: PlacementArea) -> Vector:
    """Return where a body's origin goes to stand, as it is turned, at the nearest spot with room.

    Where there is none, it is the spot that lacks least.

    Args:
        body: to put down.
        others: to keep away from.
        area: where there may be room.
    """
    x, y, z = body.position
    spots = np.array([(a, b) for a in _steps(*area.x) for b in _steps(*area.y)])
    aways = np.hypot(spots[:, 0] - x, spots[:, 1] - y)
    best = np.lexsort((aways, placement_deficit_m(spots, body, others, area)))[0]
    spot = tuple(spots[best].tolist())
    return (*spot, area.height_m(spot) + z - vertical_extent(body)[0])


def placement_deficit_m(
    spots: np.ndarray, body: Body, others: Sequence[Body], area: PlacementArea
) -> np.ndarray:
    """Return how much room is wanting at spots [S, 2]: outside the area, or beside others.

    Args:
        spots: to look at, metres.
        body: to put down.
        others: to keep away from.
        area: where there may be room.

    Returns:
        [S], metres.
    """
    low, high = np.array([area.x, area.y]).T
    outside = np.maximum(np.maximum(low - spots, spots - high), 0.0).max(axis=1)
    if not others:
        return outside
    at = np.array([other.position[:2] for other in others])
    gaps = np.hypot(*(spots[:, None] - at).transpose(2, 0, 1))
    room = (gaps - [footprint_radius_m(other) for other in others]).min(axis=1)
    return outside + np.maximum(area.gap_m + footprint_radius_m(body) - room, 0.0)


def extent_along_m(body: Body, ways: np.ndarray) -> np.ndarray:
    """Return how far a body, as it lies, reaches from its origin in directions [N, 2], [N]."""
    return ((world_vertices(body)[:, :2] - body.position[:2]) @ ways.T).max(axis=0)


def _steps(low: float, high: float) -> list[float]:
    count = max(1, round((high - low) / SPOT_STEP_M))
    return [low + (high - low) * i / count for i in range(count + 1)]
