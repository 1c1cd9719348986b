"""Terrain with slopes, given by the heights of its surface."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from ba_torchrl.core.errors import PlacementError
from ba_torchrl.core.jit import njit
from ba_torchrl.sim.bodies import Body, world_vertices
from ba_torchrl.sim.geometry import (
    Matrix,
    PlanarFrame,
    Pose,
    Vector,
    quaternion_matrix,
    surface_quaternion,
)
from ba_torchrl.sim.robots.gripper import FLOOR_CLEARANCE_M, Gripper
from ba_torchrl.tasks.terrain.flat import Terrain
from ba_torchrl.tasks.workspace import LAYOUT_ATTEMPTS, Area, Spacing, no_room, spaced

PROBE_M = 1e-4
"""Distance at which the slope at a point is measured."""
FLAT_M = 2e-4
"""Largest deviation of the surface from a plane that counts as full contact."""
UNEVEN_WEIGHT = 10.0
"""Deficit of a site per metre of unevenness or overhang."""
POSE_ATTEMPTS = 50
"""Random poses of a body before a new layout is begun."""
FOOTPRINT_POINTS = 17
"""Points along each side of the grid that represents the lower face of a body."""
RESTING_ITERATIONS = 3
"""Linearisations in the computation of a body's pose at rest."""
DEPTH_SLOPE = 1e3
"""Depth of the points from which the search for the lowest plane starts, as a multiple of the
extent of the surface. Planes up to a quarter of this slope are found."""
SUPPORT_TOLERANCE_M = 1e-12
"""Height of a point above the lowest plane by rounding."""
SHARE_TOLERANCE = 1e-12
"""Share of a corner in a point that is zero up to rounding."""

_BEARINGS = 2 * math.pi * np.arange(16) / 16
_RING = np.stack([np.cos(_BEARINGS), np.sin(_BEARINGS)], axis=1)
"""[16, 2] points of the unit circle."""


@dataclass(frozen=True)
class OrientedArea(Area):
    """The part of an axis-aligned area in a rectangle at any heading.

    Shrunk by more than half its width, it is the line along its centre.
    """

    frame: PlanarFrame
    """Centre and heading of the rectangle."""
    half_x: float
    half_y: float

    @property
    def heading_rad(self) -> float | None:
        return None if self.half_y else self.frame.yaw_rad

    def shrunk(self, border_m: float) -> OrientedArea:
        halves = {"half_x": self.half_x, "half_y": self.half_y}
        smaller = {name: max(half - border_m, 0.0) for name, half in halves.items()}
        return replace(super().shrunk(border_m), **smaller)

    def outside_m(self, points: np.ndarray) -> np.ndarray:
        """Return how far points [N, 2] are outside of the area, along one of the axes, [N]."""
        along, across = self.frame.to_local(*points.T)
        outside = np.maximum(np.abs(along) - self.half_x, np.abs(across) - self.half_y)
        return np.maximum(np.maximum(outside, 0.0), super().outside_m(points))

    def sites(self) -> np.ndarray:
        """Return a grid of points [S, 2], parallel to the rectangle."""
        points = np.array(
            [
                self.frame.to_world(a, b)
                for a in spaced(-self.half_x, self.half_x)
                for b in spaced(-self.half_y, self.half_y)
            ]
        )
        inside = super().outside_m(points) == 0
        return points[inside] if inside.any() else points

    def random_point(self, rng: np.random.Generator, padding_m: float = 0.0) -> tuple[float, float]:
        area = self.shrunk(padding_m / 2)
        for _ in range(LAYOUT_ATTEMPTS):
            local = (float(rng.uniform(-half, half)) for half in (area.half_x, area.half_y))
            point = area.frame.to_world(*local)
            if not super(OrientedArea, area).outside_m(np.array([point])).any():
                return point
        raise no_room(padding_m)


class SlopedTerrain(Terrain):
    """A surface of plane faces; subclasses return its heights."""

    rocking_steps: ClassVar[int] = 0
    """Physics steps in which objects that lie on several faces come to rest at the start."""
    layout: Any
    """The random parts of the episode; its faces are aligned with a `heading_rad`."""

    @property
    def frame(self) -> PlanarFrame:
        """The frame at the centre of the workspace whose x axis is the heading of the layout."""
        return PlanarFrame(*self.workspace.center, self.layout.heading_rad)

    @property
    def aside_area(self) -> Area:
        """The whole workspace; `uneven_m` excludes parts of it, or prefers others."""
        return self.spawn_area

    def get_state(self) -> Any:
        return self.layout

    @abstractmethod
    def heights_m(self, points: np.ndarray) -> np.ndarray:
        """Return the heights [N] of the surface at points [N, 2], metres."""

    def height_m(self, xy: tuple[float, float]) -> float:
        return float(self.heights_m(np.array([xy]))[0])

    def surface_pose(self, xy: tuple[float, float], yaw_rad: float = 0.0) -> Pose:
        _, slopes, _ = self._planes(np.array([xy]), PROBE_M)
        return Pose((*xy, self.height_m(xy)), surface_quaternion(_normal(slopes[0]), yaw_rad))

    def origin_pose(self, xy: tuple[float, float], rise_m: float, radius_m: float) -> Pose:
        """Return a frame above the plane that approximates the surface within a radius from above.

        Arguments as for `Terrain`.
        """
        heights, slopes, deviations = self._planes(np.array([xy]), radius_m)
        contact = (*xy, float(heights[0] + deviations[0]))
        orientation = surface_quaternion(_normal(slopes[0]))
        return Pose(contact, orientation).compose(Pose((0.0, 0.0, rise_m)))

    def uneven_m(self, points: np.ndarray, radius_m: float) -> np.ndarray:
        """Return the weighted deviation of the surface from a plane within a radius, [N] metres."""
        *_, deviations = self._planes(points, radius_m)
        return np.where(deviations > FLAT_M, UNEVEN_WEIGHT * deviations, 0.0)

    def overhang_m(self, points: np.ndarray, radius_m: float) -> np.ndarray:
        """Return the weighted distance by which objects of a radius leave the build area, [N]."""
        return UNEVEN_WEIGHT * self.build_area.shrunk(radius_m).outside_m(points)

    @abstractmethod
    def can_start_at(self, outline: np.ndarray) -> bool:
        """Whether a body with an outline may start there.

        Args:
            outline: [V, 2] points of the ground, metres.
        """

    def random_base_pose(
        self, rng: np.random.Generator, body: Body, draw_yaw: Callable[[Body], float]
    ) -> tuple[tuple[float, float], float] | None:
        """Return position and yaw of a body in the build area; None if no body starts there.

        Args:
            draw_yaw: returns a random yaw of a body.

        Raises:
            PlacementError: it does not fit.
        """
        return None

    def scatter(
        self,
        rng: np.random.Generator,
        bodies: Sequence[Body],
        spacings: Sequence[Spacing],
        draw_yaw: Callable[[Body], float],
        *,
        base: Body,
    ) -> None:
        """Place bodies at random poses where they may start, apart from each other."""
        for _ in range(LAYOUT_ATTEMPTS // POSE_ATTEMPTS):
            poses: dict[Body, tuple[tuple[float, float], float]] = {}
            pose = self.random_base_pose(rng, base, draw_yaw)
            if pose is not None:
                poses[base] = pose
            for body, spacing in zip(bodies, spacings, strict=True):
                if body in poses:
                    continue
                others = [xy for xy, _ in poses.values()]
                pose = self._random_pose(rng, body, spacing, draw_yaw, others)
                if pose is None:
                    break
                poses[body] = pose
            else:
                for body, (xy, yaw) in poses.items():
                    self.stand(body, xy, yaw)
                self.world.step(self.rocking_steps)
                return
        raise PlacementError(
            f"no room for {len(bodies)} objects apart from each other on this terrain: enlarge "
            "`workspace`, or lower `num_objects` or `object_scale_range`"
        )

    def _random_pose(
        self,
        rng: np.random.Generator,
        body: Body,
        spacing: Spacing,
        draw_yaw: Callable[[Body], float],
        others: Sequence[tuple[float, float]],
    ) -> tuple[tuple[float, float], float] | None:
        """Return a random position and yaw at which a body may start; None if none was found."""
        for _ in range(POSE_ATTEMPTS):
            xy = self.spawn_area.random_point(rng, spacing.padding_m)
            if any(math.dist(xy, other) < spacing.distance_m for other in others):
                continue
            yaw = draw_yaw(body)
            if self.can_start_at(footprint(body, xy, yaw)):
                return xy, yaw
        return None

    def stand(self, body: Body, xy: tuple[float, float], yaw_rad: float) -> None:
        """Place a body in static equilibrium on the surface below it.

        Its lower face lies on the lowest plane above the surface, as seen from its centre of mass.
        """
        low, high = body.shape.bounds_m
        local = _grid(low[:2], high[:2])
        center = np.array(body.shape.center_of_mass_m) - (0.0, 0.0, low[2])
        slopes, height = np.zeros(2), 0.0
        for _ in range(RESTING_ITERATIONS):
            rotation = np.array(quaternion_matrix(surface_quaternion(_normal(slopes), yaw_rad)))
            points = local @ rotation[:, :2].T + (*xy, height)
            rises = self.heights_m(points[:, :2]) - points[:, 2]
            # the point of the lower face below the centre of mass; a body whose centre of mass is
            # beside its lower face gets the tilt of the surface, and topples
            below = center[:2] - center[2] * rotation[2, :2] / rotation[2, 2]
            below = np.clip(below, 0.99 * local.min(axis=0), 0.99 * local.max(axis=0))
            gradient, offset = lowest_plane(local, rises, below)
            slopes = slopes + np.linalg.solve(rotation[:2, :2].T, gradient)
            height += offset
        orientation = surface_quaternion(_normal(slopes), yaw_rad)
        points = local @ np.array(quaternion_matrix(orientation))[:, :2].T + (*xy, height)
        height += float((self.heights_m(points[:, :2]) - points[:, 2]).max())
        body.set_pose(*Pose((*xy, height), orientation).compose(Pose((0.0, 0.0, -low[2]))))

    def gap_below_m(self, body: Body) -> float:
        """Return the least height of a body's vertices above the surface below them."""
        corners = world_vertices(body)
        return float((corners[:, 2] - self.heights_m(corners[:, :2])).min())

    def lowest_tool_m(
        self,
        gripper: Gripper,
        xy: tuple[float, float],
        rotation: Matrix | None = None,
        opening: float = 1.0,
    ) -> float:
        """Return the least height of the tool at which the fingers close above the surface.

        The lower faces of the fingertips are above the surface all along their path.
        """
        points = gripper.tip_points(rotation, opening)
        return float((self.heights_m(points[:, :2] + xy) - points[:, 2]).max()) + FLOOR_CLEARANCE_M

    def _planes(
        self, points: np.ndarray, radius_m: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the least-squares planes of the surface on circles about points.

        Args:
            radius_m: radius of the circles.

        Returns:
            Heights [N] of the planes at the points, their slopes [N, 2], and the largest height [N]
            of the surface above them, at the points or on the circles.
        """
        ring = self.heights_m((points[:, None] + radius_m * _RING).reshape(-1, 2))
        ring = ring.reshape(len(points), len(_RING))
        heights = ring.mean(axis=1)
        slopes = ring @ _RING * (2 / len(_RING) / radius_m)
        above = np.maximum(
            (ring - heights[:, None] - radius_m * slopes @ _RING.T).max(axis=1),
            self.heights_m(points) - heights,
        )
        return heights, slopes, above


def footprint(body: Body, xy: tuple[float, float], yaw_rad: float) -> np.ndarray:
    """Return the vertices [V, 2] of an upright body at a position and yaw, seen from above."""
    return np.stack(PlanarFrame(*xy, yaw_rad).to_world(*body.shape.vertices[:, :2].T), axis=1)


def lowest_plane(
    points: np.ndarray, heights: np.ndarray, center: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the plane above all heights that is lowest at a point among them.

    A rigid body whose lower face lies in this plane, and whose centre of mass is above the point,
    has the least potential energy. It touches the surface at three points or more.

    Args:
        points: [N, 2] points of the lower face, metres.
        heights: [N] heights of the surface at these points, metres.
        center: [2] the point below the centre of mass, inside the convex hull of ``points``.

    Returns:
        Slopes [2] of the plane along both axes, and its height at the origin.
    """
    # three deep points around the others are the first triangle below the centre
    reach = np.ptp(points, axis=0).max()
    corners = 4.0 * reach * np.array([[-1.0, -1.0], [1.0, -1.0], [0.0, 1.0]]) + center
    rows = np.empty((len(points) + 3, 3))
    rows[:-3, :2], rows[:-3, 2] = points, heights
    rows[-3:, :2], rows[-3:, 2] = corners, heights.min() - DEPTH_SLOPE * reach
    a, b, c = rows[_supporting_triangle(rows, np.asarray(center, dtype=np.float64))]
    normal = np.cross(b - a, c - a)
    slopes = -normal[:2] / normal[2]
    return slopes, float(a[2] - slopes @ a[:2])


@njit()
def _supporting_triangle(rows, center):  # noqa: ANN001, ANN202
    """Return the three of the points [N, 3] on the lowest plane above all of them at the centre.

    The dual simplex method: the last three points are the first triangle, which contains the
    centre as seen from above. The point highest above the plane of the triangle replaces the corner
    that leaves the centre in the triangle.
    """
    count = len(rows)
    chosen = np.array([count - 3, count - 2, count - 1])
    for _ in range(count):
        ax, ay, az = rows[chosen[0]]
        bx, by, bz = rows[chosen[1]] - rows[chosen[0]]
        cx, cy, cz = rows[chosen[2]] - rows[chosen[0]]
        area = bx * cy - by * cx
        slope_x, slope_y = (bz * cy - by * cz) / area, (bx * cz - bz * cx) / area
        farthest, largest = -1, SUPPORT_TOLERANCE_M
        for k in range(count):
            above = rows[k, 2] - az - slope_x * (rows[k, 0] - ax) - slope_y * (rows[k, 1] - ay)
            if above > largest:
                farthest, largest = k, above
        if farthest < 0:
            break
        # shares of the corners in the centre and in the new point, which sum to one
        px, py = center[0] - ax, center[1] - ay
        qx, qy = rows[farthest, 0] - ax, rows[farthest, 1] - ay
        p1, p2 = (px * cy - py * cx) / area, (bx * py - by * px) / area
        q1, q2 = (qx * cy - qy * cx) / area, (bx * qy - by * qx) / area
        leaving, least = 0, np.inf
        for k, p, q in ((0, 1.0 - p1 - p2, 1.0 - q1 - q2), (1, p1, q1), (2, p2, q2)):
            if q > SHARE_TOLERANCE and p / q < least:
                leaving, least = k, p / q
        chosen[leaving] = farthest
    return chosen


@lru_cache(maxsize=8)
def _grid(low: tuple[float, float], high: tuple[float, float]) -> np.ndarray:
    """Return a read-only grid of points [N, 2] of a rectangle, borders included."""
    axes = [np.linspace(*ends, FOOTPRINT_POINTS) for ends in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    points.flags.writeable = False
    return points


def _normal(slopes: np.ndarray) -> Vector:
    """Return the unit normal of a plane from its slopes along x and y."""
    dx, dy = map(float, slopes)
    norm = math.sqrt(dx * dx + dy * dy + 1.0)
    return -dx / norm, -dy / norm, 1.0 / norm
