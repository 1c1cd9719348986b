"""The workspace, the limits of one action, and random placements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ba_torchrl.core.errors import PlacementError
from ba_torchrl.sim.geometry import PlanarFrame, Vector

LAYOUT_ATTEMPTS = 2000
"""Random layouts before a `PlacementError`; bowl and block fit in about one of ten."""
SITE_STEP_M = 0.02
"""Grid spacing of the sites of an area."""


@dataclass(frozen=True)
class Workspace:
    """An axis-aligned box in metres."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float]

    @property
    def center(self) -> tuple[float, float]:
        """x and y of the centre."""
        return (sum(self.x) / 2, sum(self.y) / 2)

    @property
    def width(self) -> float:
        """Extent along x."""
        return self.x[1] - self.x[0]

    @property
    def upper_corner(self) -> Vector:
        """The corner with the largest coordinates."""
        return (self.x[1], self.y[1], self.z[1])

    def contains(self, point: Vector) -> bool:
        """Whether a point lies strictly inside."""
        return all(
            low < value < high
            for value, (low, high) in zip(point, (self.x, self.y, self.z), strict=True)
        )

    def clip(self, point: Sequence[float]) -> Vector:
        """Return the point of the box that is nearest to a point."""
        return tuple(
            min(max(value, low), high)
            for value, (low, high) in zip(point, (self.x, self.y, self.z), strict=True)
        )


@dataclass(frozen=True)
class ActionLimits:
    """The largest displacement and rotation of one action."""

    step_m: float
    """Displacement along each axis, metres; infinite in open loop."""
    turn_rad: float
    """Rotation about the vertical; 0 if the gripper cannot turn."""
    yaw_range_rad: tuple[float, float] | None = None
    """Range to which the yaw of the gripper is clipped; None without bounds."""
    can_tilt: bool = False
    """Whether the gripper can approach along any direction instead of only straight down."""


class Spacing(NamedTuple):
    """The space that an object needs where it is placed at random."""

    padding_m: float
    """Twice the least distance between its centre and the border."""
    distance_m: float
    """Least distance between its centre and those of the objects placed before it."""


class Area(NamedTuple):
    """An axis-aligned rectangle of the horizontal plane, metres."""

    x: tuple[float, float]
    y: tuple[float, float]

    @property
    def heading_rad(self) -> None:
        """None: pieces may have any yaw."""
        return None

    def outside_m(self, points: np.ndarray) -> np.ndarray:
        """Return how far points [N, 2] are outside of the area, along x or along y, [N]."""
        low, high = np.array([self.x, self.y]).T
        return np.maximum(np.maximum(low - points, points - high), 0.0).max(axis=1)

    def sites(self) -> np.ndarray:
        """Return a grid of points [S, 2]."""
        return np.array([(a, b) for a in _grid(*self.x) for b in _grid(*self.y)])

    def shrunk(self, border_m: float) -> Area:
        """Return the area less a border of this width."""
        return Area(*((low + border_m, high - border_m) for low, high in self))

    def random_point(self, rng: np.random.Generator, padding_m: float = 0.0) -> tuple[float, float]:
        """Return a uniformly random point at least half of ``padding_m`` from the border.

        Raises:
            PlacementError: the area is smaller than the padding.
        """
        point = []
        for low, high in self:
            low, high = low + padding_m / 2, high - padding_m / 2
            if low >= high:
                raise PlacementError(
                    f"an object that keeps {padding_m / 2:.3f} m from the border does not fit: "
                    "enlarge `workspace` or lower `object_scale_range`"
                )
            point.append(float(rng.uniform(low, high)))
        return tuple(point)


class OrientedArea(NamedTuple):
    """A rectangle at any heading, cut off at the borders of an axis-aligned one.

    Shrunk by more than half its width, it is the line along its centre.
    """

    frame: PlanarFrame
    """Centre and heading."""
    half_x: float
    half_y: float
    within: Area
    """The points of the rectangle outside of it do not belong to the area."""

    @property
    def heading_rad(self) -> float | None:
        """Heading of an area that is only a line; None for a wider one."""
        return None if self.half_y else self.frame.yaw_rad

    def shrunk(self, border_m: float) -> OrientedArea:
        """Return the area less a border of this width."""
        return self._replace(
            half_x=max(self.half_x - border_m, 0.0),
            half_y=max(self.half_y - border_m, 0.0),
            within=self.within.shrunk(border_m),
        )

    def outside_m(self, points: np.ndarray) -> np.ndarray:
        """Return how far points [N, 2] are outside of the area, along one of the axes, [N]."""
        along, across = self.frame.to_local(*points.T)
        outside = np.maximum(np.abs(along) - self.half_x, np.abs(across) - self.half_y)
        return np.maximum(np.maximum(outside, 0.0), self.within.outside_m(points))

    def sites(self) -> np.ndarray:
        """Return a grid of points [S, 2], parallel to the rectangle."""
        grid = np.array(
            [
                self.frame.to_world(a, b)
                for a in _grid(-self.half_x, self.half_x)
                for b in _grid(-self.half_y, self.half_y)
            ]
        )
        inside = self.within.outside_m(grid) == 0
        return grid[inside] if inside.any() else grid

    def random_point(self, rng: np.random.Generator, padding_m: float = 0.0) -> tuple[float, float]:
        """Return a uniformly random point at least half of ``padding_m`` from the border.

        Raises:
            PlacementError: no point was found.
        """
        area = self.shrunk(padding_m / 2)
        for _ in range(LAYOUT_ATTEMPTS):
            local = (float(rng.uniform(-half, half)) for half in (area.half_x, area.half_y))
            point = area.frame.to_world(*local)
            if not area.within.outside_m(np.array([point])).any():
                return point
        raise PlacementError(
            f"an object that keeps {padding_m / 2:.3f} m from the border does not fit: enlarge "
            "`workspace` or lower `object_scale_range`"
        )


Region = Area | OrientedArea
"""A convex part of the horizontal plane."""


def random_points(
    region: Region, rng: np.random.Generator, spacings: Sequence[Spacing]
) -> list[tuple[float, float]]:
    """Return uniformly random points of a region, one for each object, that keep their distances.

    Raises:
        PlacementError: no layout was found.
    """
    for _ in range(LAYOUT_ATTEMPTS):
        points: list[tuple[float, float]] = []
        for spacing in spacings:
            point = region.random_point(rng, spacing.padding_m)
            if any(math.dist(point, other) < spacing.distance_m for other in points):
                break
            points.append(point)
        else:
            return points
    raise PlacementError(
        f"no room for {len(spacings)} objects apart from each other: enlarge `workspace`, or "
        "lower `num_objects` or `object_scale_range`"
    )


def _grid(low: float, high: float) -> list[float]:
    count = max(1, round((high - low) / SITE_STEP_M))
    return [low + (high - low) * i / count for i in range(count + 1)]
