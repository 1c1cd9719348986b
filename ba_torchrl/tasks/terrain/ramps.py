"""Two parallel ramps with level ground between them (appendix C)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ba_torchrl.core.errors import PlacementError
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import PlanarFrame, Pose, quaternion_product, yaw_quaternion
from ba_torchrl.sim.shapes import Box, Color
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.terrain.sloped import OrientedArea, SlopedTerrain, footprint
from ba_torchrl.tasks.workspace import LAYOUT_ATTEMPTS, Workspace

GAP_M = (0.04, 0.2)
"""Range of the distance between the ramps."""
SLOPE_RAD = (0.0, math.pi / 6)
"""Range of the slope of each ramp."""
EDGE_M = (0.0, 0.01)
"""Range of the height of each ramp's lower edge above the ground."""
OFFSET_SHARE = 0.25
"""Largest offset of the gap's centre from the workspace's, as a multiple of the
difference between the widest and the present gap."""
BORDER_M = 0.03
"""Distance by which the ramps extend beyond the corners of the workspace."""
FRICTION = 1.0
"""Objects of friction 1 slide at slopes above 45 degrees."""
COLORS: tuple[Color, Color] = ((0.62, 0.7, 0.78, 1.0), (0.55, 0.63, 0.72, 1.0))
EDGE_MARGIN_M = 2e-3
"""Least distance of an object from the edges of the ramps at the start."""
INSIDE_DEFICIT_M = 0.02
"""Deficit of sites between the ramps for objects that are placed aside."""
YAW_ATTEMPTS = 100
"""Random yaws of the object between the ramps before it is aligned with them."""


class RampLayout(NamedTuple):
    """The random parts of the ramps; pairs are of the ramp to the left of the heading and to the
    right of it."""

    heading_rad: float
    """Heading of the edges."""
    distances_m: tuple[float, float]
    """Distances of the lower edges from the centre of the workspace."""
    edges_m: tuple[float, float]
    """Heights of the lower edges above the ground."""
    slopes_rad: tuple[float, float]


class Ramps(SlopedTerrain):
    """Two ramps that rise away from the strip of level ground between their parallel edges.

    Args:
        world: not sealed yet.
    """

    place_words = ", between the ramps"

    def __init__(self, world: World, workspace: Workspace) -> None:
        super().__init__(world, workspace)
        radius_m = math.hypot(*(high - low for low, high in self.spawn_area.bounds)) / 2 + BORDER_M
        length_m = radius_m / math.cos(SLOPE_RAD[1])
        self.size_m = (2 * radius_m, length_m, length_m * math.tan(SLOPE_RAD[1]) + BORDER_M)
        """Extents of a ramp along its edge, up the slope and perpendicular to it."""
        self.least_gap_m = GAP_M[0]
        """Least distance between the ramps in the next episode."""
        shapes = [
            Box(size_m=self.size_m, mass_kg=0.0, friction=FRICTION, color=color) for color in COLORS
        ]
        self.ramps = [world.add(shape, f"ramp {i + 1}") for i, shape in enumerate(shapes)]
        half = GAP_M[1] / 2
        self._set_layout(RampLayout(0.0, (half, half), (0.0, 0.0), (0.0, 0.0)))

    @property
    def support_ids(self) -> frozenset[int]:
        """PyBullet ids of the ramps and the floor."""
        return frozenset((self.world.floor, *(ramp.id for ramp in self.ramps)))

    @property
    def base_ids(self) -> frozenset[int]:
        """PyBullet id of the floor."""
        return frozenset((self.world.floor,))

    @property
    def build_area(self) -> OrientedArea:
        """The strip between the ramps."""
        first, second = self.layout.distances_m
        offset, half = (first - second) / 2, (first + second) / 2
        center = self.frame.to_world(0.0, offset)
        frame = PlanarFrame(*center, self.layout.heading_rad)
        return OrientedArea(*self.spawn_area.bounds, frame, self.size_m[0] / 2, half)

    def reserve(self, width_m: float) -> None:
        """Leave a gap between the ramps of the next episodes in which such a piece can be grasped.

        Raises:
            ValueError: the widest gap is too narrow.
        """
        needed_m = width_m + 2 * EDGE_MARGIN_M
        if needed_m > GAP_M[1]:
            raise ValueError(
                f"pieces of {needed_m:.3f} m are wider than the widest gap, {GAP_M[1]} m"
            )
        self.least_gap_m = max(GAP_M[0], needed_m)

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Draw gap, heading, slopes and heights."""
        gap = float(rng.uniform(self.least_gap_m, GAP_M[1]))
        offset = float(rng.uniform(-1.0, 1.0)) * OFFSET_SHARE * (GAP_M[1] - gap)
        heading = float(rng.uniform(0.0, 2 * math.pi))
        edges, slopes = (tuple(rng.uniform(*ends, size=2).tolist()) for ends in (EDGE_M, SLOPE_RAD))
        distances = (gap / 2 + offset, gap / 2 - offset)
        self._set_layout(RampLayout(heading, distances, edges, slopes))

    def set_state(self, state: RampLayout) -> None:
        self.layout = state

    def heights_m(self, points: np.ndarray) -> np.ndarray:
        _, across = self.frame.to_local(*points.T)
        heights = np.zeros(len(points))
        for side, distance, edge, slope in zip(
            (1, -1),
            self.layout.distances_m,
            self.layout.edges_m,
            self.layout.slopes_rad,
            strict=True,
        ):
            beyond = side * across - distance
            heights = np.where(beyond >= 0, edge + beyond * math.tan(slope), heights)
        return heights

    def uneven_m(self, points: np.ndarray, radius_m: float) -> np.ndarray:
        """Return the unevenness as `SlopedTerrain`, plus a deficit of sites between the ramps."""
        is_between = self.build_area.outside_m(points) == 0
        return super().uneven_m(points, radius_m) + INSIDE_DEFICIT_M * is_between

    def can_start_at(self, outline: np.ndarray) -> bool:
        """Whether an outline [V, 2] lies on one side of each edge, with a margin."""
        _, across = self.frame.to_local(*outline.T)
        first, second = self.layout.distances_m
        return all(
            offsets.min() > EDGE_MARGIN_M or offsets.max() < -EDGE_MARGIN_M
            for offsets in (across - first, across + second)
        )

    def random_base_pose(
        self, rng: np.random.Generator, body: Body, draw_yaw: Callable[[Body], float]
    ) -> tuple[tuple[float, float], float]:
        """Return position and yaw of a body between the ramps, aligned with them if it must be."""
        area = self.build_area
        limit = area.half_y - EDGE_MARGIN_M
        for attempt in range(LAYOUT_ATTEMPTS):
            yaw = draw_yaw(body) if attempt < YAW_ATTEMPTS else area.frame.yaw_rad
            turned = PlanarFrame(0.0, 0.0, yaw - area.frame.yaw_rad)
            _, across = turned.to_world(*body.shape.vertices[:, :2].T)
            low, high = -limit - float(across.min()), limit - float(across.max())
            if low > high:
                continue
            along = float(rng.uniform(-area.half_x, area.half_x))
            xy = area.frame.to_world(along, float(rng.uniform(low, high)))
            if not self.spawn_area.outside_m(footprint(body, xy, yaw)).any():
                return xy, yaw
        raise PlacementError(
            f"{body.name} does not fit between ramps {2 * area.half_y:.3f} m apart: enlarge "
            "`workspace` or lower `object_scale_range`"
        )

    # ----------------------------------------------------------------------------------------

    def _set_layout(self, layout: RampLayout) -> None:
        """Move the ramps to a layout."""
        self.layout = layout
        _, length, thickness = self.size_m
        from_edge = Pose((0.0, length / 2, -thickness / 2))
        for i, (ramp, turn) in enumerate(zip(self.ramps, (0.0, math.pi), strict=True)):
            side = 1 if i == 0 else -1
            x, y = self.frame.to_world(0.0, side * layout.distances_m[i])
            half = layout.slopes_rad[i] / 2
            tilt = (math.sin(half), 0.0, 0.0, math.cos(half))
            orientation = quaternion_product(yaw_quaternion(layout.heading_rad + turn), tilt)
            ramp.set_pose(*Pose((x, y, layout.edges_m[i]), orientation).compose(from_edge))
