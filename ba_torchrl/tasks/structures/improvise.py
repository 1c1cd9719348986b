"""The pieces of the improvised houses: random shapes in place of cubes (appendix A.1, figure 12).

A world takes no new bodies once it is sealed, so a pool of shapes in several sizes is loaded at the
start, and every episode draws from it.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np

from ba_torchrl.sim.assets.cache import cached_parts
from ba_torchrl.sim.assets.hulls import convex_hull, surface_samples, volume_and_center
from ba_torchrl.sim.assets.random_shapes import UNIT_M, read_shape, shape_path
from ba_torchrl.sim.bodies import Body, Box, Color, Shape, Solid
from ba_torchrl.sim.meshes import Mesh
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.base import Spot
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.motion_primitives import FINGER_HALF_M
from ba_torchrl.tasks.open_loop_task import OpenLoopTask
from ba_torchrl.tasks.structures.blueprint import CUBOID, Piece, Span
from ba_torchrl.tasks.structures.open_loop import Part, StructureTask
from ba_torchrl.tasks.structures.parts import BLUE
from ba_torchrl.tasks.structures.planner import StructurePlanner

NUMBERS = (2, 5, 27, 32, 66, 75, 83, 116, 118, 131, 137, 142, 143, 149, 154, 176, 187, 199, 200)
"""Shapes of figure 12, as PyBullet numbers them."""
SIZES = 3
"""Of each shape."""
CUBOIDS = 12
"""Random cuboids in the pool."""
SHAPE_UNIT_M = 0.01
"""Metres per unit of a mesh file at scale 1."""
WIDE = (0.6, 0.9)
"""Range of the horizontal scale."""
HIGH = (1.2, 1.32)
"""Range of the vertical scale, which gives heights of 2.5 to 3 cm."""
CUBOID_M = ((0.025, 0.035), (0.075, 0.105), (0.02, 0.035))
"""Range of each edge of a random cuboid."""
SHAPE_GAP_M = (-0.02, 0.008, 0.02)
"""Gap between two shapes next to each other, along the line between their centres: least, aimed
for, most. Below zero they stand side by side at an angle."""
ROOM_M = 0.015
"""Gap between pieces at the start, beyond the circles around them."""
SAMPLES = 4000
SKIN_M = 2e-3
"""Points of a surface that is sampled, and the depth of those that a finger meets."""
WIDTH_WEIGHT = 2.0
"""What a metre of width costs, measured in cosines between sides and fingers."""
ORANGE: Color = (0.9, 0.55, 0.2, 1.0)

SHAPE = Piece("shape", stays_upright=True)
"""Any of the random shapes; one on its side carries nothing, and no pick about the vertical rights
it."""
UP = ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0))


class ImproviseTask(StructureTask):
    """A roof on two random shapes, drawn anew in every episode."""

    has_cuboid: bool = False
    """Whether there is a cuboid too, which is random as well."""

    @abstractmethod
    def parts(self) -> Sequence[Part]:
        """Return the pieces that are the same in every episode."""

    def build(self, world: World) -> None:
        """Load the pieces, shapes and cuboids of all sizes among them."""
        self._fixed = [(world.add(part.shape, part.piece.kind), part) for part in self.parts()]
        shapes = [(f"shape {number:03d}", shape) for number, shape in random_shapes()]
        cuboids = [("cuboid", shape) for shape in random_cuboids()] if self.has_cuboid else []
        self._pool = BodyPool(
            world,
            [shape for _, shape in [*shapes, *cuboids]],
            [name for name, _ in [*shapes, *cuboids]],
        )
        self._shape_pieces = [shape_piece(shape) for _, shape in shapes]
        self._shape_count = len(shapes)
        self._choose([*range(2), *([len(shapes)] if cuboids else [])])

    def randomise(self, rng: np.random.Generator) -> None:
        """Draw the shapes, and put all pieces anywhere apart from each other."""
        self._pool.clear()
        chosen = rng.choice(self._shape_count, size=2, replace=False).tolist()
        if self.has_cuboid:
            chosen.append(int(rng.integers(self._shape_count, len(self._pool.bodies))))
        self._choose(chosen)
        super().randomise(rng)

    def get_state(self) -> Any:
        """Return which bodies of the pool are in the scene."""
        return self._pool.get_state()

    def set_state(self, state: Any) -> None:
        """Take up what `get_state` returned."""
        self._pool.set_state(state)
        self._equip()

    def pick_height_m(self, top_m: float) -> float:
        """Return the height of the tool for a pick; these pieces are low."""
        return OpenLoopTask.pick_height_m(self, top_m)

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the square searched for the highest point.

        Shapes go to the floor: what stands beside them must not count.
        """
        if held is not None and self.planner.pieces[held].kind == SHAPE.kind:
            return OpenLoopTask.window_m(self, held)
        return super().window_m(held)

    # ----------------------------------------------------------------------------------------

    def _choose(self, indices: Sequence[int]) -> None:
        """Bring bodies of the pool."""
        self._pool.clear()
        for index in indices:
            self._pool.activate(self._pool.bodies[index])
        self._equip()

    def _equip(self) -> None:
        """Make pieces and blueprint of the bodies in the scene."""
        present = list(self._pool.present)
        self.bodies = [*(body for body, _ in self._fixed), *present]
        kinds = {part.piece.kind: [body] for body, part in self._fixed}
        kinds[SHAPE.kind] = present[:2]
        if self.has_cuboid:
            kinds[CUBOID.kind] = present[2:]
        own = {body: self._shape_pieces[self._pool.bodies.index(body)] for body in present[:2]}
        self.planner = StructurePlanner(
            self.blueprint(), self.world, kinds, self.block_m, own_pieces=own
        )
        pieces = self.planner.pieces
        self._parts = []
        largest_radius_m = 0.0
        for body in self.bodies:
            low, high = body.shape.bounds_m
            radius = math.hypot(*(max(-a, b) for a, b in zip(low[:2], high[:2], strict=True)))
            spot = Spot(2 * radius, largest_radius_m + radius + ROOM_M)
            largest_radius_m = max(largest_radius_m, radius)
            self._parts.append(Part(pieces[body], body.shape, spot))


def shape_span() -> Span:
    """Return how two shapes stand next to each other."""
    least, aim, most = SHAPE_GAP_M
    return Span(least, aim, most, gap_m=aim)


def random_shapes() -> list[tuple[int, Solid]]:
    """Return number and body of each shape in each of its sizes, spread evenly over the ranges."""
    found = []
    for k, number in enumerate(NUMBERS):
        hull = _hull(number)
        for size in range(SIZES):
            # the heights go round, so that size and height are not tied
            wide = _share(WIDE, (size + 0.5) / SIZES)
            high = _share(HIGH, ((size + k) % SIZES + 0.5) / SIZES)
            vertices = hull.vertices * (wide, wide, high) * SHAPE_UNIT_M
            center = np.array(volume_and_center(Mesh(vertices, hull.faces))[1])
            middle = (vertices[:, 2].min() + vertices[:, 2].max()) / 2
            mesh = Mesh(vertices - (*center[:2], middle), hull.faces)
            solid = Solid(
                parts=(mesh,), color=ORANGE, center_of_mass_m=(0.0, 0.0, float(center[2] - middle))
            )
            found.append((number, solid))
    return found


def random_cuboids() -> list[Shape]:
    """Return cuboids of random edges, the same ones every time."""
    low, high = np.array(CUBOID_M).T
    sizes = np.random.default_rng(0).uniform(low, high, (CUBOIDS, 3))
    return [Box(size_m=tuple(size), color=BLUE) for size in sizes.tolist()]


def shape_piece(shape: Shape) -> Piece:
    """Return what a random shape is to a builder.

    It is held by its middle, at the yaw at which the sides that the fingers meet are most square
    to them, and narrow.
    """
    points, normals = surface_samples(shape.mesh(), SAMPLES)
    level = np.abs(points[:, 2]) < FINGER_HALF_M
    points, normals = points[level, :2], normals[level, :2]

    def quality(yaw: float) -> float:
        axis = np.array([math.cos(yaw), math.sin(yaw)])
        met = np.abs(points @ (-axis[1], axis[0])) < FINGER_HALF_M
        along, facing = points[met] @ axis, normals[met]
        first = facing[along < along.min() + SKIN_M].mean(axis=0)
        last = facing[along > along.max() - SKIN_M].mean(axis=0)
        square = min(-first @ last, -first @ axis, last @ axis)
        return float(square - WIDTH_WEIGHT * np.ptp(along))

    yaws = (np.arange(-18, 18) * math.pi / 36).tolist()
    return Piece(SHAPE.kind, math.pi, (max(yaws, key=quality),), UP, stays_upright=True)


def _hull(number: int) -> Mesh:
    """Return the convex hull of a shape in the units of its file."""

    def make() -> list[Mesh]:
        mesh = read_shape(number)
        return [convex_hull(mesh.vertices / UNIT_M)]

    return cached_parts(shape_path(number).read_bytes(), "hull, units of the file", make)[0]


def _share(span: tuple[float, float], share: float) -> float:
    low, high = span
    return low + share * (high - low)
