"""Footprints of containers, bodies and fingers as rectangles, and the gaps between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body, world_vertices
from ba_torchrl.sim.geometry import PlanarFrame
from ba_torchrl.tasks.workspace import Workspace

WIDTH_YAWS = 12
"""Directions per half turn in which the width of a body is compared."""
WIDTH_TOLERANCE_M = 5e-4
"""Half widths within this of the least one count as equal."""
BEARINGS = 16
"""Directions per half turn along which the gap between two outlines is measured."""

_DIRECTIONS = np.array(
    [[math.cos(a), math.sin(a)] for a in np.arange(BEARINGS) * math.pi / BEARINGS]
).T


class Rectangle(NamedTuple):
    """A rectangle in the horizontal plane, metres and radians."""

    x: float
    y: float
    yaw_rad: float
    half_x: float
    """Half its extent along its own x axis."""
    half_y: float
    """Half its extent along its own y axis."""

    @property
    def frame(self) -> PlanarFrame:
        """Frame of its centre, its axes along the sides."""
        return PlanarFrame(self.x, self.y, self.yaw_rad)

    @property
    def corners(self) -> np.ndarray:
        """Its corners, [4, 2]."""
        local = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * (self.half_x, self.half_y)
        return np.stack(self.frame.to_world(*local.T), axis=1)

    def resized(self, half_x: float, half_y: float) -> Rectangle:
        """Return a rectangle of another size with the same centre and yaw."""
        return self._replace(half_x=half_x, half_y=half_y)

    def contains(self, points: np.ndarray) -> bool:
        """Whether x and y of all points [N, 2 or more] lie in it."""
        along, across = map(np.abs, self.frame.to_local(points[:, 0], points[:, 1]))
        return bool(along.max() <= self.half_x and across.max() <= self.half_y)

    def is_inside(self, workspace: Workspace) -> bool:
        """Whether x and y of its corners lie in a workspace."""
        ex, ey = self.extents_m(0.0)
        return all(
            low <= center - extent and center + extent <= high
            for center, extent, (low, high) in (
                (self.x, ex, workspace.x),
                (self.y, ey, workspace.y),
            )
        )

    def extents_m(self, yaw_rad: float) -> tuple[float, float]:
        """Return half its extents along the axes of a frame with this yaw."""
        cos = abs(math.cos(self.yaw_rad - yaw_rad))
        sin = abs(math.sin(self.yaw_rad - yaw_rad))
        return cos * self.half_x + sin * self.half_y, sin * self.half_x + cos * self.half_y


def gap_m(first: Rectangle, second: Rectangle) -> float:
    """Return the largest gap between two rectangles along a side of either; negative in overlap.

    It is a lower bound of their distance, and equal to it unless their corners are nearest.
    """
    gap = -math.inf
    for a, b in ((first, second), (second, first)):
        dx, dy = a.frame.to_local(b.x, b.y)
        ex, ey = b.extents_m(a.yaw_rad)
        gap = max(gap, abs(dx) - a.half_x - ex, abs(dy) - a.half_y - ey)
    return gap


def gaps_m(first: Sequence[Rectangle], second: Sequence[Rectangle]) -> np.ndarray:
    """Return `gap_m` of every rectangle of one list [N] and every one of another [M], [N, M]."""
    one, other = (
        np.array(rectangles, dtype=float).reshape(-1, 5) for rectangles in (first, second)
    )

    def along_sides(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the largest gap along a side of the rectangles of ``a``."""
        x, y, yaw, half_x, half_y = np.moveaxis(b, -1, 0) - np.moveaxis(a * (1, 1, 1, 0, 0), -1, 0)
        cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
        turn_cos, turn_sin = np.abs(np.cos(yaw)), np.abs(np.sin(yaw))
        along = np.abs(cos * x + sin * y) - a[..., 3] - (turn_cos * half_x + turn_sin * half_y)
        across = np.abs(cos * y - sin * x) - a[..., 4] - (turn_sin * half_x + turn_cos * half_y)
        return np.maximum(along, across)

    return np.maximum(
        along_sides(one[:, None], other[None]), along_sides(other[None], one[:, None])
    )


def outline(body: Body, yaw_rad: float | None = None) -> Rectangle:
    """Return the bounding rectangle of a body's footprint.

    Args:
        yaw_rad: yaw of the rectangle; the body's yaw if None.
    """
    yaw = body.yaw_rad if yaw_rad is None else yaw_rad
    (rectangle,) = _bounding_rectangles(world_vertices(body), [yaw])
    return rectangle


def narrowest(body: Body, yaw_rad: float | None = None) -> list[Rectangle]:
    """Return the bounding rectangles of a body's footprint with the least extent along x.

    Args:
        yaw_rad: the only yaw to consider; `WIDTH_YAWS` yaws if None.

    Returns:
        One rectangle for each yaw at which the extent is least.
    """
    corners = world_vertices(body)
    if yaw_rad is not None:
        return _bounding_rectangles(corners, [yaw_rad])
    # the axes of the body first: their rectangles are the tightest
    yaws = [body.yaw_rad + math.pi * i / WIDTH_YAWS for i in range(WIDTH_YAWS)]
    yaws.sort(key=lambda yaw: round((yaw - body.yaw_rad) / (math.pi / 2), 6) % 1 > 0)
    found = _bounding_rectangles(corners, yaws)
    least = min(rectangle.half_x for rectangle in found)
    return [rectangle for rectangle in found if rectangle.half_x <= least + WIDTH_TOLERANCE_M]


def _bounding_rectangles(corners: np.ndarray, yaws_rad: Sequence[float]) -> list[Rectangle]:
    """Return the bounding rectangle with each yaw of x and y of points [N, 3]."""
    cos, sin = (np.array([[f(yaw)] for yaw in yaws_rad]) for f in (math.cos, math.sin))
    x, y = corners[:, 0], corners[:, 1]
    along, across = cos * x + sin * y, cos * y - sin * x  # in frames at the world's origin
    ends = (along.min(1), along.max(1), across.min(1), across.max(1))
    rectangles = []
    for yaw, x0, x1, y0, y1 in zip(yaws_rad, *(e.tolist() for e in ends), strict=True):
        center = PlanarFrame(0.0, 0.0, yaw).to_world((x0 + x1) / 2, (y0 + y1) / 2)
        rectangles.append(Rectangle(*center, yaw, (x1 - x0) / 2, (y1 - y0) / 2))
    return rectangles


def extents_m(points: np.ndarray) -> np.ndarray:
    """Return the extremes [..., 2, BEARINGS] of points [..., V, 2] along each bearing."""
    along = points @ _DIRECTIONS
    return np.stack([along.min(axis=-2), along.max(axis=-2)], axis=-2)


def separation_m(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return lower bounds of the distances between outlines.

    Args:
        one: [..., 2, BEARINGS] extremes, as `extents_m` returns.
        other: the same; leading dimensions are broadcast.

    Returns:
        [...] metres.
    """
    gaps = np.maximum(one[..., 0, :] - other[..., 1, :], other[..., 0, :] - one[..., 1, :])
    return gaps.max(axis=-1)
