"""A bumpy surface of nine pyramids with a platform on it (appendix C)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ba_torchrl.core.errors import PlacementError
from ba_torchrl.core.jit import njit
from ba_torchrl.sim.geometry import PlanarFrame
from ba_torchrl.sim.meshes import Mesh
from ba_torchrl.sim.shapes import Box, Color, Solid
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.manipulation.footprints import Rectangle
from ba_torchrl.tasks.terrain.sloped import OrientedArea, SlopedTerrain
from ba_torchrl.tasks.workspace import Workspace

SLOPE_RAD = (0.0, math.pi / 12)
"""Range of the slope of a pyramid."""
PYRAMIDS_PER_ROW = 3
BASE_SHARE = 0.5
"""Edge of a pyramid's base, as a multiple of the workspace's width."""
VARIANTS = 27
"""Pyramids of evenly spaced slopes; every episode uses nine of them."""
UNDERGROUND_M = 0.02
"""Depth of the pyramids' bases below the ground, so that the shallowest has a thickness."""
FRICTION = 1.0
COLORS: tuple[Color, Color] = ((0.8, 0.75, 0.64, 1.0), (0.72, 0.67, 0.56, 1.0))
PLATFORM_COLOR: Color = (0.6, 0.66, 0.72, 1.0)
CLEARANCE_M = 0.03
"""Least distance of an object from the platform at the start, with space for a finger."""


class BumpLayout(NamedTuple):
    """The random parts of the bumps."""

    pyramids: tuple[int, ...]
    """Numbers of the pyramids, row by row."""
    heading_rad: float
    """Heading of the rows."""
    platform: PlanarFrame
    """Centre and heading of the platform."""


class Bumps(SlopedTerrain):
    """Nine square pyramids side by side, and a platform as high as the highest pyramid can be.

    Args:
        world: not sealed yet.
        workspace: bounds of the task; the pyramids have its centre.
        platform_m: extents of the platform along its x and y axis.
        random_orientation: whether the platform has a random heading.
    """

    place_words = ", between the bumps"
    rocking_steps = 20

    def __init__(
        self,
        world: World,
        workspace: Workspace,
        platform_m: tuple[float, float],
        *,
        random_orientation: bool,
    ) -> None:
        super().__init__(world, workspace)
        self.platform_m = platform_m
        self.random_orientation = random_orientation
        self.base_m = BASE_SHARE * workspace.width
        low, high = SLOPE_RAD
        self.slopes_rad = [low + (i + 0.5) / VARIANTS * (high - low) for i in range(VARIANTS)]
        """Slope of each pyramid of the pool."""
        self._slopes = np.tan(self.slopes_rad)
        self.top_m = self.base_m / 2 * math.tan(high)
        """Height of the platform."""
        self.pool = BodyPool(
            world,
            [
                _pyramid(self.base_m, slope, COLORS[i % len(COLORS)])
                for i, slope in enumerate(self.slopes_rad)
            ],
            [f"pyramid {i + 1}" for i in range(VARIANTS)],
        )
        size = (*platform_m, self.top_m + UNDERGROUND_M)
        self.platform = world.add(
            Box(size_m=size, mass_kg=0.0, friction=FRICTION, color=PLATFORM_COLOR), "platform"
        )
        pyramids = (body.id for body in self.pool.bodies)
        self._support_ids = frozenset((world.floor, self.platform.id, *pyramids))
        self._set_layout(
            BumpLayout(tuple(range(PYRAMIDS_PER_ROW**2)), 0.0, PlanarFrame(*workspace.center, 0.0))
        )

    @property
    def support_ids(self) -> frozenset[int]:
        """PyBullet ids of the floor, all pyramids and the platform."""
        return self._support_ids

    @property
    def base_ids(self) -> frozenset[int]:
        """PyBullet id of the platform."""
        return frozenset((self.platform.id,))

    @property
    def build_area(self) -> OrientedArea:
        """The platform."""
        half_x, half_y = (size / 2 for size in self.platform_m)
        return OrientedArea(*self.spawn_area.bounds, self.layout.platform, half_x, half_y)

    @property
    def goal_frame(self) -> PlanarFrame:
        """Centre and heading of the platform."""
        return self.layout.platform

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Draw the pyramids, their heading, and the pose of the platform inside the workspace."""
        pyramids = rng.choice(VARIANTS, size=PYRAMIDS_PER_ROW**2, replace=False)
        heading = float(rng.uniform(0.0, math.pi))
        yaw = float(rng.uniform(0.0, 2 * math.pi)) if self.random_orientation else math.pi / 2
        half_x, half_y = (size / 2 for size in self.platform_m)
        extents = Rectangle(0.0, 0.0, yaw, half_x, half_y).extents_m(0.0)
        center = []
        for (low, high), extent in zip(self.spawn_area.bounds, extents, strict=True):
            if low + extent > high - extent:
                raise PlacementError(
                    f"the platform of {2 * half_x:.3g} m by {2 * half_y:.3g} m does not fit: "
                    "enlarge `workspace` or lower `object_scale_range`"
                )
            center.append(float(rng.uniform(low + extent, high - extent)))
        self._set_layout(BumpLayout(tuple(pyramids.tolist()), heading, PlanarFrame(*center, yaw)))

    def set_state(self, state: BumpLayout) -> None:
        self._use_layout(state)
        self.pool.set_state(state.pyramids)

    def heights_m(self, points: np.ndarray) -> np.ndarray:
        points = np.ascontiguousarray(points, dtype=np.float64)
        heights = np.empty(len(points))
        _surface_heights(points, *self._surface, heights)
        return heights

    def uneven_m(self, points: np.ndarray, radius_m: float) -> np.ndarray:
        """Return how far objects of a radius reach over the platform, [N] metres."""
        area = self.build_area
        along, across = np.abs(np.stack(area.frame.to_local(*points.T)))
        gap = np.maximum(along - area.half_x, across - area.half_y)
        return np.maximum(radius_m + CLEARANCE_M - gap, 0.0)

    def can_start_at(self, outline: np.ndarray) -> bool:
        """Whether an outline [V, 2] is clear of the platform."""
        area = self.build_area
        along, across = np.stack(area.frame.to_local(*outline.T))
        gaps = (
            max(values.min() - half, -half - values.max())
            for values, half in ((along, area.half_x), (across, area.half_y))
        )
        return max(gaps) > CLEARANCE_M

    # ----------------------------------------------------------------------------------------

    def _use_layout(self, layout: BumpLayout) -> None:
        """Compute heights from a layout."""
        self.layout = layout
        platform, (length, width) = layout.platform, self.platform_m
        self._surface = (
            np.array([*self.workspace.center, *_cos_sin(layout.heading_rad), self.base_m]),
            self._slopes[list(layout.pyramids)],
            np.array([platform.x, platform.y, *_cos_sin(platform.yaw_rad)]),
            np.array([length / 2, width / 2, self.top_m]),
            np.array([self.workspace.x, self.workspace.y]),
        )

    def _set_layout(self, layout: BumpLayout) -> None:
        """Move the pyramids and the platform to a layout."""
        self._use_layout(layout)
        self.pool.clear()
        half = (PYRAMIDS_PER_ROW - 1) / 2
        for cell, number in enumerate(layout.pyramids):
            row, column = divmod(cell, PYRAMIDS_PER_ROW)
            x, y = self.frame.to_world((row - half) * self.base_m, (column - half) * self.base_m)
            body = self.pool.bodies[number]
            self.pool.activate(body)
            body.place((x, y, 0.0), layout.heading_rad)
        x, y, yaw = layout.platform
        self.platform.place((x, y, (self.top_m - UNDERGROUND_M) / 2), yaw)


def _pyramid(base_m: float, slope_rad: float, color: Color) -> Solid:
    """Return a square pyramid whose base's upper edge is at height 0, on a block underground."""
    half = base_m / 2
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    vertices = [(x, y, z) for z in (-UNDERGROUND_M, 0.0) for x, y in corners]
    vertices.append((0.0, 0.0, half * math.tan(slope_rad)))
    faces = [(0, 2, 1), (0, 3, 2)]
    for i in range(4):
        j = (i + 1) % 4
        faces += [(i, j, j + 4), (i, j + 4, i + 4), (i + 4, j + 4, 8)]
    mesh = Mesh(np.array(vertices), np.array(faces, dtype=np.int64))
    return Solid(parts=(mesh,), mass_kg=0.0, friction=FRICTION, color=color)


def _cos_sin(angle_rad: float) -> tuple[float, float]:
    return math.cos(angle_rad), math.sin(angle_rad)


@njit()
def _surface_heights(points, bumps, slopes, platform, size, bounds, heights):  # noqa: ANN001, ANN202
    """Compute the heights of the bumps and the platform.

    Args:
        points: [N, 2] metres.
        bumps: x and y of the centre, cos and sin of the heading, edge of a pyramid's base.
        slopes: [9] tangents of the pyramids' slopes, row by row.
        platform: x and y of its centre, cos and sin of its yaw.
        size: half the extents of the platform, and its height.
        bounds: [2, 2] lower and upper bound of x and of y; the platform ends there.
        heights: [N] result, metres.
    """
    center_x, center_y, cos, sin, base = bumps
    platform_x, platform_y, platform_cos, platform_sin = platform
    half_x, half_y, top = size
    for n in range(points.shape[0]):
        x, y = points[n]
        dx, dy = x - platform_x, y - platform_y
        if (
            abs(platform_cos * dx + platform_sin * dy) <= half_x
            and abs(platform_cos * dy - platform_sin * dx) <= half_y
            and bounds[0, 0] <= x <= bounds[0, 1]
            and bounds[1, 0] <= y <= bounds[1, 1]
        ):
            heights[n] = top
            continue
        dx, dy = x - center_x, y - center_y
        row = (cos * dx + sin * dy) / base + PYRAMIDS_PER_ROW / 2
        column = (cos * dy - sin * dx) / base + PYRAMIDS_PER_ROW / 2
        i = min(max(math.floor(row), 0), PYRAMIDS_PER_ROW - 1)
        j = min(max(math.floor(column), 0), PYRAMIDS_PER_ROW - 1)
        offset = max(abs(row - i - 0.5), abs(column - j - 0.5))
        heights[n] = slopes[PYRAMIDS_PER_ROW * i + j] * base * max(0.5 - offset, 0.0)
