"""The workspace, the reach of one action, and random placements."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ba_torchrl.errors import PlacementError
from ba_torchrl.sim.geometry import Vector

LAYOUT_ATTEMPTS = 2000
"""Random layouts tried before giving up; bowl and block fit in about one of ten."""


@dataclass(frozen=True)
class Workspace:
    """An axis-aligned box in metres."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float]

    @property
    def center(self) -> tuple[float, float]:
        """x and y of the middle."""
        return (sum(self.x) / 2, sum(self.y) / 2)

    @property
    def width(self) -> float:
        """Extent along x."""
        return self.x[1] - self.x[0]

    def contains(self, point: Vector) -> bool:
        """Whether a point lies strictly inside."""
        return all(
            low < value < high
            for value, (low, high) in zip(point, (self.x, self.y, self.z), strict=True)
        )

    def clip(self, point: Sequence[float]) -> Vector:
        """Return the nearest point of the box."""
        return tuple(
            min(max(value, low), high)
            for value, (low, high) in zip(point, (self.x, self.y, self.z), strict=True)
        )


@dataclass(frozen=True)
class ActionLimits:
    """The largest displacement and rotation of one action."""

    step_m: float
    """Along each axis; infinite in open loop."""
    turn_rad: float
    """About the vertical; 0 if the gripper cannot turn."""
    yaw_range_rad: tuple[float, float] | None = None
    """Range that the gripper's yaw is clipped to; None if it is unbounded."""


class Spot(NamedTuple):
    """Space that an object needs where it is placed at random."""

    padding_m: float
    """Twice the least distance of its centre from the border."""
    distance_m: float
    """Least distance of its centre from those placed before it."""


class Area(NamedTuple):
    """A rectangle of the horizontal plane along the axes, metres."""

    x: tuple[float, float]
    y: tuple[float, float]

    def shrunk(self, border_m: float) -> Area:
        """Return the area without a border of this width."""
        return Area(*((low + border_m, high - border_m) for low, high in self))

    def random_point(self, rng: np.random.Generator, padding_m: float) -> tuple[float, float]:
        """Return a uniform point that keeps half of ``padding_m`` from the border.

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

    def random_points(
        self,
        rng: np.random.Generator,
        spots: Sequence[Spot],
        is_free: Callable[[tuple[float, float], Spot], bool] = lambda point, spot: True,
    ) -> list[tuple[float, float]]:
        """Return uniform points, one for each spot, that keep their distances from each other.

        Args:
            rng: draws the points.
            spots: space that each object needs.
            is_free: whether an object may be centred at a point.

        Raises:
            PlacementError: no layout was found.
        """
        for _ in range(LAYOUT_ATTEMPTS):
            points: list[tuple[float, float]] = []
            for spot in spots:
                point = self.random_point(rng, spot.padding_m)
                if not is_free(point, spot) or any(
                    math.dist(point, other) < spot.distance_m for other in points
                ):
                    break
                points.append(point)
            else:
                return points
        raise PlacementError(
            f"no room for {len(spots)} objects apart from each other: enlarge `workspace`, or "
            "lower `num_objects` or `object_scale_range`"
        )
