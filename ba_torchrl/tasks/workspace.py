"""The workspace, the limits of one action, and random placements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from typing_extensions import Self

from ba_torchrl.core.errors import PlacementError
from ba_torchrl.sim.geometry import Vector

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
    """Least distance between its centre and the centres of objects placed before it."""


@dataclass(frozen=True)
class Area:
    """An axis-aligned rectangle of the horizontal plane, metres."""

    x: tuple[float, float]
    y: tuple[float, float]

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The ranges of x and y."""
        return self.x, self.y

    @property
    def heading_rad(self) -> float | None:
        """Heading of an area that is only a line; None: pieces may have any yaw."""
        return None

    def outside_m(self, points: np.ndarray) -> np.ndarray:
        """Return how far points [N, 2] are outside of the area, along x or along y, [N]."""
        low, high = np.array(self.bounds).T
        return np.maximum(np.maximum(low - points, points - high), 0.0).max(axis=1)

    def sites(self) -> np.ndarray:
        """Return a grid of points [S, 2]."""
        return np.array([(a, b) for a in spaced(*self.x) for b in spaced(*self.y)])

    def shrunk(self, border_m: float) -> Self:
        """Return the area less a border of this width."""
        x, y = ((low + border_m, high - border_m) for low, high in self.bounds)
        return replace(self, x=x, y=y)

    def random_point(self, rng: np.random.Generator, padding_m: float = 0.0) -> tuple[float, float]:
        """Return a uniformly random point at least half of ``padding_m`` from the border.

        Raises:
            PlacementError: the area is smaller than the padding.
        """
        point = []
        for low, high in self.bounds:
            low, high = low + padding_m / 2, high - padding_m / 2
            if low >= high:
                raise no_room(padding_m)
            point.append(float(rng.uniform(low, high)))
        return tuple(point)


def no_room(padding_m: float) -> PlacementError:
    """Return the error of an area that is smaller than a padding."""
    return PlacementError(
        f"an object that keeps {padding_m / 2:.3f} m from the border does not fit: enlarge "
        "`workspace` or lower `object_scale_range`"
    )


def random_points(
    area: Area, rng: np.random.Generator, spacings: Sequence[Spacing]
) -> list[tuple[float, float]]:
    """Return uniformly random points of an area, one for each object, that keep their distances.

    Raises:
        PlacementError: no layout was found.
    """
    for _ in range(LAYOUT_ATTEMPTS):
        points: list[tuple[float, float]] = []
        for spacing in spacings:
            point = area.random_point(rng, spacing.padding_m)
            if any(math.dist(point, other) < spacing.distance_m for other in points):
                break
            points.append(point)
        else:
            return points
    raise PlacementError(
        f"no room for {len(spacings)} objects apart from each other: enlarge `workspace`, or "
        "lower `num_objects` or `object_scale_range`"
    )


def spaced(low: float, high: float) -> list[float]:
    """Return evenly spaced numbers from low to high, about `SITE_STEP_M` apart."""
    count = max(1, round((high - low) / SITE_STEP_M))
    return [low + (high - low) * i / count for i in range(count + 1)]
