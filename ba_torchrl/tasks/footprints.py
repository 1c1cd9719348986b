"""Rectangles in the plane: where containers, bodies and fingers are, and whether they meet."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body, world_vertices
from ba_torchrl.sim.geometry import PlanarFrame
from ba_torchrl.tasks.workspace import Workspace

WIDTH_YAWS = 12
"""Directions in which an object is measured."""
AS_NARROW_M = 5e-4


class Rectangle(NamedTuple):
    """A rectangle in the plane, metres and radians."""

    x: float
    y: float
    yaw_rad: float
    half_x: float
    """Half its extent along its own x axis."""
    half_y: float

    @property
    def frame(self) -> PlanarFrame:
        """Frame of its centre, x along its first side."""
        return PlanarFrame(self.x, self.y, self.yaw_rad)

    def resized(self, half_x: float, half_y: float) -> Rectangle:
        """Return one of another size about the same centre."""
        return self._replace(half_x=half_x, half_y=half_y)

    def contains(self, points: np.ndarray) -> bool:
        """Whether all points [N, 2 or more] lie in it, whatever their height."""
        along, across = map(np.abs, self.frame.to_local(points[:, 0], points[:, 1]))
        return bool(along.max() <= self.half_x and across.max() <= self.half_y)

    def is_inside(self, workspace: Workspace) -> bool:
        """Whether its corners lie in the workspace's floor area."""
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
    """Return how far apart two rectangles are along the sides of either; negative if they overlap.

    It is the distance where a side faces the other, and less than that across corners.
    """
    gap = -math.inf
    for a, b in ((first, second), (second, first)):
        dx, dy = a.frame.to_local(b.x, b.y)
        ex, ey = b.extents_m(a.yaw_rad)
        gap = max(gap, abs(dx) - a.half_x - ex, abs(dy) - a.half_y - ey)
    return gap


def outline(body: Body, yaw_rad: float | None = None) -> Rectangle:
    """Return the rectangle around a body, as it lies, seen from above.

    Args:
        body: the body.
        yaw_rad: of the rectangle; the body's own unless given.
    """
    yaw = body.yaw_rad if yaw_rad is None else yaw_rad
    return _around(world_vertices(body), yaw)


def narrowest(body: Body, yaw_rad: float | None = None) -> list[Rectangle]:
    """Return the rectangles around a body along whose x axis it is narrowest.

    Args:
        body: the body.
        yaw_rad: measure along this direction only.

    Returns:
        One, or as many as there are directions in which the body is as narrow.
    """
    corners = world_vertices(body)
    if yaw_rad is not None:
        return [_around(corners, yaw_rad)]
    # its own axes first: they fit best
    yaws = [body.yaw_rad + math.pi * i / WIDTH_YAWS for i in range(WIDTH_YAWS)]
    yaws.sort(key=lambda yaw: round((yaw - body.yaw_rad) / (math.pi / 2), 6) % 1 > 0)
    found = [_around(corners, yaw) for yaw in yaws]
    least = min(rectangle.half_x for rectangle in found)
    return [rectangle for rectangle in found if rectangle.half_x <= least + AS_NARROW_M]


def _around(corners: np.ndarray, yaw_rad: float) -> Rectangle:
    """Return the rectangle with this yaw around points [N, 3] seen from above."""
    frame = PlanarFrame(0.0, 0.0, yaw_rad)
    along, across = frame.to_local(corners[:, 0], corners[:, 1])
    (x0, x1), (y0, y1) = ((float(values.min()), float(values.max())) for values in (along, across))
    middle = frame.to_world((x0 + x1) / 2, (y0 + y1) / 2)
    return Rectangle(*middle, yaw_rad, (x1 - x0) / 2, (y1 - y0) / 2)
