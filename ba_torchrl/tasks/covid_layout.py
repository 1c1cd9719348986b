"""The layout of the covid test: a test area and two boxes, for new and for used tubes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from ba_torchrl.errors import PlacementError
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import PlanarFrame
from ba_torchrl.sim.shapes import Box, Color
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.terrain import Terrain

PURPLE: Color = (0.6, 0.45, 0.78, 1.0)
GRAY: Color = (0.6, 0.6, 0.6, 1.0)
YELLOW: Color = (0.93, 0.8, 0.3, 1.0)

SHEET_M = 2e-3
"""Height of the test area, and of the floors of both boxes, above the ground."""
WALL_M = 4e-3
"""Thickness of the walls of both boxes."""
UNDERGROUND_M = 0.05
"""Depth of the boxes below the ground. Fast objects would pass through a thin sheet."""
HALF_LAYOUT_M = 0.15
"""Half the edge of the square that the three areas fill."""
COLUMN_M = 0.05
"""Distance between neighbours in the box of new tubes; the fingers fit between them."""
GAP_M = 3e-3
"""Least gap between tubes and swabs."""


class Area(NamedTuple):
    """One of the three areas."""

    name: str
    color: Color
    center: tuple[float, float]
    """In the frame of the layout, metres."""
    size: tuple[float, float, float]
    """Outer extents, metres."""


NEW_BOX = Area("box of new tubes", PURPLE, (-0.06, 0.055), (0.18, 0.19, 0.01))
USED_BOX = Area("box of used tubes", YELLOW, (-0.09, -0.1), (0.12, 0.1, 0.04))
TEST_AREA = Area("test area", GRAY, (0.0925, 0.0), (0.115, 0.3, SHEET_M))
AREAS = (NEW_BOX, USED_BOX, TEST_AREA)

TEST_SITES = tuple((0.0, y) for y in (0.0, 0.085, -0.085, 0.0425, -0.0425))
"""Positions in the frame of the test area at which the expert presents tubes and swabs."""
USED_ROWS = tuple((0.0, y) for y in (0.0, 0.024, -0.024))
"""Positions in the frame of the box of used tubes for tubes along its length."""
USED_COLUMNS = tuple((x, 0.0) for x in (0.0, 0.03, -0.03))
"""Positions in the frame of the box of used tubes for tubes across its length."""


class CovidLayout:
    """The three areas as static bodies of a world.

    Args:
        world: not sealed yet.
        terrain: the ground.
    """

    def __init__(self, world: World, terrain: Terrain) -> None:
        self.terrain = terrain
        floors = [world.add(_slab(area, area.size[:2], SHEET_M), area.name) for area in AREAS]
        self.new_box, self.used_box, self.test_area = floors
        self._slabs = [(area, (0.0, 0.0), floor) for area, floor in zip(AREAS, floors, strict=True)]
        self.walls: list[Body] = []
        """The walls of both boxes."""
        for area in (NEW_BOX, USED_BOX):
            for xy, size in _walls(area):
                wall = world.add(_slab(area, size, area.size[2]), f"wall of the {area.name}")
                self._slabs.append((area, xy, wall))
                self.walls.append(wall)

    def place(self, center: tuple[float, float], yaw_rad: float, mirror: float) -> None:
        """Place the layout.

        Args:
            center: its centre, metres.
            yaw_rad: its yaw.
            mirror: -1 to mirror it along its x axis, else 1.
        """
        for area, xy, body in self._slabs:
            x, y = area.center
            area_xy = PlanarFrame(*center, yaw_rad).to_world(mirror * x, y)
            xy = PlanarFrame(*area_xy, yaw_rad).to_world(*xy)
            z = self.terrain.height_m(xy) - UNDERGROUND_M - body.shape.bounds_m[0][2]
            body.place((*xy, z), yaw_rad)

    def floor_z_m(self, xy: tuple[float, float]) -> float:
        """Return the height of the floors of the areas at a point."""
        return self.terrain.height_m(xy) + SHEET_M

    def to_world(self, area: Body, xy: tuple[float, float]) -> tuple[float, float]:
        """Return a point in the frame of an area as a point in the world."""
        return PlanarFrame(*area.position[:2], area.yaw_rad).to_world(*xy)

    def lay(self, body: Body, xy: tuple[float, float], yaw_rad: float) -> None:
        """Place a tube or swab on the floor of an area."""
        body.place((*xy, self.floor_z_m(xy) - body.shape.bounds_m[0][2]), yaw_rad)

    def is_above(self, area: Body, size_m: Sequence[float], body: Body) -> bool:
        """Whether the centre of a body is above a rectangle of a size around an area's centre."""
        frame = PlanarFrame(*area.position[:2], area.yaw_rad)
        local = frame.to_local(*body.position[:2])
        return all(abs(x) < extent / 2 for x, extent in zip(local, size_m, strict=False))

    def is_in_used_box(self, body: Body) -> bool:
        """Whether the centre of a body is in the box of used tubes, below its rim."""
        length, width, rim = USED_BOX.size
        inner = (length - 2 * WALL_M, width - 2 * WALL_M)
        is_below_rim = body.position[2] - self.terrain.height_m(body.position[:2]) < rim
        return is_below_rim and self.is_above(self.used_box, inner, body)

    @property
    def used_rim_m(self) -> float:
        """Height of the rim of the box of used tubes."""
        return self.terrain.height_m(self.used_box.position[:2]) + USED_BOX.size[2]


def new_rows(tube_m: float, swab_m: float) -> tuple[float, float]:
    """Return y of the centres of new tubes and of new swabs, in the frame of their box.

    Args:
        tube_m: length of a tube.
        swab_m: length of a swab.

    Raises:
        PlacementError: they do not fit into the box.
    """
    inner = NEW_BOX.size[1] / 2 - WALL_M
    gap = (2 * inner - tube_m - swab_m) / 3
    if gap < GAP_M:
        raise PlacementError(
            f"tubes of {tube_m:.3f} m and swabs of {swab_m:.3f} m do not fit into their box: lower "
            "`object_scale_range`"
        )
    return inner - gap - tube_m / 2, gap + swab_m / 2 - inner


def new_columns(count: int) -> list[float]:
    """Return x of the centres of new tubes and swabs, in the frame of their box."""
    return [(i - (count - 1) / 2) * COLUMN_M for i in range(count)]


def layout_half_m(yaw_rad: float) -> float:
    """Return half the extent of the layout along the axes of the workspace."""
    return HALF_LAYOUT_M * (abs(math.cos(yaw_rad)) + abs(math.sin(yaw_rad)))


def _slab(area: Area, size_m: tuple[float, float], top_m: float) -> Box:
    return Box(size_m=(*size_m, top_m + UNDERGROUND_M), mass_kg=0, color=area.color)


def _walls(area: Area) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Return position, in the frame of the area, and size of each wall of a box.

    Each wall is a body of its own, as objects creep on a body of several convex hulls.
    """
    (x, y, _), wall = area.size, WALL_M
    sides = [((0.0, (y - wall) / 2), (x - 2 * wall, wall)), (((x - wall) / 2, 0.0), (wall, y))]
    return [((sign * px, sign * py), size) for (px, py), size in sides for sign in (-1.0, 1.0)]
