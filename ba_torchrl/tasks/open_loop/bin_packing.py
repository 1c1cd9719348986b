"""Bin Packing: place all objects in a bin (appendix A.1)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.core.actions import PickPlaceCommand, wrap_angle
from ba_torchrl.core.errors import PlacementError
from ba_torchrl.sim.bodies import Body, vertical_extent, world_vertices
from ba_torchrl.sim.geometry import PlanarFrame
from ba_torchrl.sim.meshes import Mesh, centroid, gable_mesh, prism_mesh, rod_mesh
from ba_torchrl.sim.shapes import Box, Color, Shape, Solid
from ba_torchrl.sim.vision.depth import HeightCamera
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.instructions import colored, counted
from ba_torchrl.tasks.manipulation.footprints import Rectangle, outline
from ba_torchrl.tasks.manipulation.pick_place_commands import no_op, perturbed_pick, pick_command
from ba_torchrl.tasks.packing.base import RELEASE_GAP_M, PackingTask, open_box
from ba_torchrl.tasks.packing.layout import Footprint, random_rectangle, scatter

BIN_M = (0.176, 0.144, 0.08)
"""Outer extents of the bin, at the appendix's size."""
WALL_M = 0.004
"""Thickness of the bin's walls, at the appendix's size."""
FLOOR_M = 0.004
"""Thickness of the bin's floor, at the appendix's size."""
RELEASE_HEIGHT_M = 0.012
"""Height of the tool above the rim at a release, with the fingers outside the bin."""
TOLERANCE_M = 1e-3
"""Distance by which a packed object may extend beyond the inner walls."""
GRASP_DEPTH_M = 0.011
"""Depth of a grasp below the top of an object, above the support of a flat one."""
EAVES_M = 0.026
"""Height of the vertical sides of a gable, at the appendix's size."""
FREE_HALF_M = (0.06, 0.016)
"""Half the extents of the free area around an object at the start, at the appendix's size."""
LAYOUTS = 20
"""Random positions of the bin before a `PlacementError`."""

PIXEL_M = 0.001
"""Width of a pixel of the bin's height image."""
GAP_M = 0.0015
"""Gap around an object in the bin."""
RING_M = 0.008
"""Width of the surroundings of a site."""
TALLER_M = 0.01
"""Height above a site from which its surroundings enclose it."""
LEVEL_M = 0.004
"""Step to which the heights of sites are rounded for that comparison."""
UNEVEN_COST = 0.5
"""Cost of the height of a site above its mean height."""
OPEN_COST_M = 0.01
"""Cost of a site without enclosing surroundings, as a height."""
TIE_M = 0.0015
"""Costs within this of the least one are equal."""
SPACING_M = 0.005
"""Edge of the squares of which each has at most one of the equal sites."""
ORDER = (1.0, 0.3)
"""Weights of the distances along and across the bin in the order of equal sites."""


def object_shapes(unit: float) -> dict[str, Shape]:
    """Return the shapes of all kinds of objects, centred on the origin, longest along y.

    Args:
        unit: sizes as a multiple of those in the appendix.
    """
    wide, long, flat = 0.04 * unit, 0.08 * unit, 0.02 * unit
    angles = 2 * np.pi * np.arange(16) / 16
    circle = (wide / 2 * np.stack([np.cos(angles), np.sin(angles)], axis=1)).tolist()
    turn = 2 * np.pi / 16  # an octagonal rod that lies on a side
    rod = rod_mesh(long, wide / math.cos(np.pi / 8), sides=8)
    cos, sin = math.cos(turn), math.sin(turn)
    x, y, z = rod.vertices.T
    lying = Mesh(np.stack([cos * x + sin * z, y, cos * z - sin * x], axis=1), rod.faces)

    def solid(mesh: Mesh, color: Color) -> Solid:
        return Solid(parts=(mesh,), color=color, center_of_mass_m=centroid([mesh]))

    return {
        "brick": Box(size_m=(wide, long, wide), color=(0.75, 0.3, 0.25, 1.0)),
        "plank": Box(size_m=(wide, long, flat), color=(0.85, 0.65, 0.35, 1.0)),
        "cube": Box(size_m=(wide, wide, wide), color=(0.3, 0.5, 0.8, 1.0)),
        "tile": Box(size_m=(wide, wide, flat), color=(0.4, 0.7, 0.45, 1.0)),
        "disc": solid(prism_mesh(circle, -flat / 2, flat / 2), (0.55, 0.4, 0.7, 1.0)),
        "gable": solid(
            gable_mesh((wide, long, wide), eaves_m=EAVES_M * unit), (0.35, 0.7, 0.7, 1.0)
        ),
        "rod": solid(lying, (0.8, 0.45, 0.6, 1.0)),
    }


@TASKS.register("open_loop/bin_packing")
class BinPacking(PackingTask):
    """Objects: one to ten of seven shapes, 4 x 4 x 2 to 8 x 4 x 4 cm, eight by default, and a bin.

    Goal: all objects lie in the bin of 17.6 x 14.4 x 8 cm, with their centres below its rim, and
    none is held. The episode ends early when an object leaves the workspace. Paper, appendix A.1.
    """

    expert_version = 1
    equal_moves = 32
    scale_limits = (0.78, 0.86)
    max_steps = 20
    num_objects = 8
    num_objects_range = (1, 10)
    container_m = BIN_M

    def load_scene(self) -> None:
        """Load the bin, and as many objects of each shape as an episode may draw."""
        size = tuple(extent * self.unit for extent in BIN_M)
        wall, floor = WALL_M * self.unit, FLOOR_M * self.unit
        self.container = self.world.add(open_box(size, wall, floor, (0.6, 0.62, 0.66, 1.0)), "bin")
        kinds = object_shapes(self.unit)
        copies = self.settings.num_objects
        self.pool = BodyPool(
            self.world,
            [shape for shape in kinds.values() for _ in range(copies)],
            [f"{name} {i + 1}" for name in kinds for i in range(copies)],
        )
        self._camera = HeightCamera(self.world.bodies)

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place the bin at a random pose, and random objects around it."""
        count = self.settings.num_objects
        half_x, half_y, _ = (size * self.unit / 2 for size in BIN_M)
        hand = tuple(size * self.unit for size in FREE_HALF_M)
        for attempt in range(LAYOUTS):
            # fixed orientations: two by three of the largest objects fit side by side
            around = random_rectangle(self, rng, half_x, half_y, fixed_yaw_rad=math.pi / 2)
            kinds = rng.integers(len(self.pool.bodies) // count, size=count).tolist()
            chosen = [self.pool.bodies[kind * count + i] for i, kind in enumerate(kinds)]
            footprints = [Footprint(*body.shape.bounds_m[1][:2], *hand) for body in chosen]
            try:
                places = scatter(self, rng, footprints, [around], clear_of=around)
                break
            except PlacementError:
                if attempt == LAYOUTS - 1:
                    raise
        self.stand(self.container, (around.x, around.y), around.yaw_rad)
        self.pool.clear()
        for body, (xy, yaw) in zip(chosen, places, strict=True):
            self.pool.activate(body)
            self.stand(body, xy, yaw)

    def evaluate(self) -> dict[str, bool]:
        """Return whether all objects lie in the bin and whether none is held."""
        return {
            "is_released": self.robot.held_body() not in self.objects,
            "is_packed": all(map(self.is_packed, self.objects)),
        }

    def is_packed(self, body: Body) -> bool:
        """Whether an object is within the walls of the bin and its centre below the rim."""
        return body.position[2] < self._rim_m() and self._inside(-TOLERANCE_M).contains(
            world_vertices(body)
        )

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a pick without z, just below the highest point."""
        return max(top_m - GRASP_DEPTH_M * self.unit, self.lowest_tool_m(xy))

    def place_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a place without z: above the rim, or on the ground."""
        if top_m - self.terrain.height_m(xy) < FLOOR_M * self.unit / 2:
            return super().place_height_m(top_m, xy)
        return max(super().place_height_m(top_m, xy), self._release_m())

    def obstacles(self, body: Body | None, above_m: float) -> list[Rectangle]:
        """Return the outlines of the obstacles of the fingers, with one outline for each wall."""
        held = self.robot.held_body()
        found = [
            outline(other)
            for other in self.pool.active
            if other is not body and other is not held and vertical_extent(other)[1] > above_m
        ]
        return found + self._walls() if self._rim_m() > above_m else found

    def instruction(self) -> str:
        """Return the instruction with the number of objects and the bin's colour."""
        return (
            f"put the {counted(len(self.objects), 'object')} into the "
            f"{colored(self.container, 'bin')}"
        )

    def expert_command(self) -> PickPlaceCommand:
        """Pick the largest object that can be grasped, of equals that nearest to the bin, and drop
        it in the bin."""
        return next(self._moves())

    def expert_moves(self) -> list[PickPlaceCommand]:
        """Return that command, then picks of the equally large objects from all free sides, or
        drops at the equally good sites."""
        return list(itertools.islice(self._moves(), self.equal_moves))

    def _moves(self) -> Iterator[PickPlaceCommand]:
        """Yield the command of `expert_command` and its equals."""
        held = self.robot.held_body()
        if held is not None:
            yield from self._drops(held)
            return
        outside = [body for body in self.objects if not self.is_packed(body)]
        if not outside:
            yield no_op(self.settings.workspace, is_holding=False)
            return
        grasps = {body: self.equal_grasps(body) for body in outside}

        def order(body: Body) -> tuple[float, float, float]:
            clearance = grasps[body][0].clearance_m
            if clearance <= 0:
                return clearance, 0.0, 0.0
            size = float(np.ptp(body.shape.vertices, axis=0).prod())
            distance_m = math.dist(body.position[:2], self.container.position[:2])
            return math.inf, round(size, 7), -distance_m

        ranked = sorted(outside, key=order, reverse=True)
        first = grasps[ranked[0]][0]
        if first.clearance_m <= 0:
            yield perturbed_pick(self.world, ranked[0], first.tool, self.action_limits)
            return
        for body in ranked:
            if order(body)[:2] == order(ranked[0])[:2]:
                yield from (pick_command(grasp.tool) for grasp in grasps[body])

    def grasp_sides(self, body: Body) -> list[Rectangle]:
        """Return the sides between which fingers fit, first those with the hand along the bin's
        wall: no image shows which of the equal sides of a cube or a disc is its first."""
        x, y, _ = (a - b for a, b in zip(body.position, self.container.position, strict=True))
        along = math.atan2(y, x) + math.pi / 2
        turns = [
            (wrap_angle(side.yaw_rad - along, math.pi), side) for side in super().grasp_sides(body)
        ]
        turns.sort(key=lambda pair: abs(pair[0]))
        return [side._replace(yaw_rad=along + turn) for turn, side in turns]

    # ----------------------------------------------------------------------------------------

    def _rim_m(self) -> float:
        """Return the height of the bin's rim."""
        return self.container.position[2] + BIN_M[2] * self.unit / 2

    def _release_m(self) -> float:
        """Return the height of the tool as it releases an object."""
        return self._rim_m() + RELEASE_HEIGHT_M

    def _inside(self, margin_m: float = 0.0) -> Rectangle:
        """Return the inner outline of the bin, less a margin."""
        outer, margin = self.container_outline(), WALL_M * self.unit + margin_m
        return outer.resized(outer.half_x - margin, outer.half_y - margin)

    def _walls(self) -> list[Rectangle]:
        """Return the outlines of the bin's walls."""
        inside, thin = self._inside(), WALL_M * self.unit / 2
        x, y = inside.half_x + thin, inside.half_y + thin
        ends = [(side * x, 0.0, thin, y) for side in (-1, 1)]
        sides = [(0.0, side * y, x, thin) for side in (-1, 1)]
        return [
            Rectangle(*inside.frame.to_world(along, across), inside.yaw_rad, *half)
            for along, across, *half in ends + sides
        ]

    def _drops(self, held: Body) -> Iterator[PickPlaceCommand]:
        """Yield the places that drop an object at the sites with the lowest costs.

        Of equal orientations, that in which fingers close along the bin comes first; of equal
        sites, the one nearest to the corner farthest from the workspace's centre.
        """
        inside, tool_yaw = self._inside(), self.robot.tool_pose()[1]
        own, heights = outline(held, tool_yaw), self._heights()
        yaws = [0.0]
        if self.action_limits.turn_rad:
            yaws = [inside.yaw_rad, inside.yaw_rad + math.pi / 2]
        turned = [own._replace(yaw_rad=yaw).extents_m(inside.yaw_rad) for yaw in yaws]
        found = [_Sites.of(heights, half) for half in turned]
        least = [sites.costs.min(initial=math.inf) for sites in found]
        number = next(i for i, cost in enumerate(least) if cost <= min(least) + TIE_M)
        # the centre of the outline is placed at the site, not the origin of the object
        ox, oy = held.position[0] - own.x, held.position[1] - own.y

        def drop(yaw: float, site: Sequence[float], top: float) -> PickPlaceCommand:
            x, y = inside.frame.to_world(*site)
            z = max(self._release_m(), top + self.depth_m(held) + RELEASE_GAP_M)
            at = PlanarFrame(x, y, yaw - tool_yaw).to_world(ox, oy)
            return self.place(held, (*at, held.position[2]), yaw - tool_yaw)._replace(z_m=z)

        if not found[number].costs.size:  # the object is too large for the bin
            yield drop(yaws[number], (0.0, 0.0), 0.0)
            return
        away = np.sign(inside.frame.to_local(*self.settings.workspace.center)) * -1.0
        for i in (number, *(i for i in range(len(yaws)) if i != number)):
            sites = found[i].within(least[number] + TIE_M)
            ranked = np.argsort(-(sites.centers @ (away * ORDER)), kind="stable")
            cells = np.round(sites.centers[ranked] / SPACING_M)
            _, kept = np.unique(cells, axis=0, return_index=True)
            for j in ranked[np.sort(kept)]:
                yield drop(yaws[i], sites.centers[j].tolist(), float(sites.tops[j]))

    def _heights(self) -> np.ndarray:
        """Return the height image of the bin with its walls, rows along its length."""
        inside = self._inside()
        count = round(2 * inside.half_x / PIXEL_M) + 2
        return self._camera.heightmap((inside.x, inside.y), count * PIXEL_M, count, inside.yaw_rad)


class _Sites(NamedTuple):
    """The sites of a box in a height image, rows along the bin; none if the box is larger."""

    centers: np.ndarray
    """[R, C, 2] relative to the centre of the image."""
    tops: np.ndarray
    """[R, C] heights of their highest points."""
    costs: np.ndarray
    """[R, C] costs: low, even and enclosed by their surroundings is best. All in metres."""

    def within(self, cost_m: float) -> _Sites:
        """Return the sites with at most this cost, in one dimension."""
        chosen = self.costs <= cost_m
        return _Sites(self.centers[chosen], self.tops[chosen], self.costs[chosen])

    @classmethod
    def of(cls, heights: np.ndarray, half_m: tuple[float, float]) -> _Sites:
        """Return the sites.

        Args:
            heights: [N, N] height image in metres, with pixels of `PIXEL_M`.
            half_m: half the extents of the box along rows and columns.
        """
        size = [round(2 * (half + GAP_M) / PIXEL_M) for half in half_m]
        if max(size) > min(heights.shape):
            return cls(np.zeros((0, 0, 2)), np.zeros((0, 0)), np.zeros((0, 0)))
        ring = round(RING_M / PIXEL_M)
        tops = _window_maxima(_window_maxima(heights, size[0]).T, size[1]).T
        means = _window_sums(heights, size) / (size[0] * size[1])
        wide = [extent + 2 * ring for extent in size]
        around = np.pad(heights, ring, mode="edge")
        taller = np.zeros(tops.shape)
        levels = np.round(tops / LEVEL_M)
        for level in set(levels.ravel().tolist()):
            is_taller = around > level * LEVEL_M + TALLER_M
            at = levels == level
            taller[at] = _window_sums(is_taller, wide)[at]
        enclosed = taller / (wide[0] * wide[1] - size[0] * size[1])
        costs = tops + UNEVEN_COST * (tops - means) + OPEN_COST_M * (1 - enclosed)
        rows, columns = (
            (np.arange(count) + (extent - whole) / 2) * PIXEL_M
            for count, extent, whole in zip(tops.shape, size, heights.shape, strict=True)
        )
        return cls(np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1), tops, costs)


def _window_maxima(values: np.ndarray, size: int) -> np.ndarray:
    """Return the maxima of ``size`` successive rows of an array [N, M], [N - size + 1, M].

    The filters of ``scipy.ndimage`` take four times as long, and a quarter of a second to import.
    """
    width = 1
    while 2 * width <= size:
        values = np.maximum(values[:-width], values[width:])
        width *= 2
    overlap = size - width  # two windows of the largest power of two cover the rest
    return np.maximum(values[: len(values) - overlap], values[overlap:])


def _window_sums(values: np.ndarray, size: Sequence[int]) -> np.ndarray:
    """Return the sum over every window of a size in an array [N, M]."""
    sums = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    sums[1:, 1:] = values.cumsum(axis=0).cumsum(axis=1)
    rows, columns = size
    return (
        sums[rows:, columns:]
        - sums[:-rows, columns:]
        - sums[rows:, :-columns]
        + sums[:-rows, :-columns]
    )
