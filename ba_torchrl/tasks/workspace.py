"""The workspace, the limits of one action, and random placements."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ba_torchrl.errors import PlacementError
from ba_torchrl.sim.geometry import Vector

LAYOUT_ATTEMPTS = 2000
"""Random layouts before a `PlacementError`; bowl and block fit in about one of ten."""


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

    def shrunk(self, border_m: float) -> Area:
        """Return the area less a border of this width."""
        return Area(*((low + border_m, high - border_m) for low, high in self))

    def random_point(self, rng: np.random.Generator, padding_m: float) -> tuple[float, float]:
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

    def random_points(
        self,
        rng: np.random.Generator,
        spacings: Sequence[Spacing],
        is_allowed: Callable[[tuple[float, float], Spacing], bool] = lambda point, spacing: True,
    ) -> list[tuple[float, float]]:
        """Return uniformly random points, one for each object, that keep their distances.

        Args:
            rng: random generator.
            spacings: space that each object needs.
            is_allowed: whether an object with a spacing may be centred at a point.

        Raises:
            PlacementError: no layout was found.
        """
        for _ in range(LAYOUT_ATTEMPTS):
            points: list[tuple[float, float]] = []
            for spacing in spacings:
                point = self.random_point(rng, spacing.padding_m)
                if not is_allowed(point, spacing) or any(
                    math.dist(point, other) < spacing.distance_m for other in points
                ):
                    break
                points.append(point)
            else:
                return points
        raise PlacementError(
            f"no room for {len(spacings)} objects apart from each other: enlarge `workspace`, or "
            "lower `num_objects` or `object_scale_range`"
        )
