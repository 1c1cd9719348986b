"""Procedural household items that consist of convex parts, so that cups and bowls are hollow."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from ba_torchrl.sim.assets.base import OBJECT_SETS, ObjectSet
from ba_torchrl.sim.assets.hulls import convex_hull
from ba_torchrl.sim.meshes import Mesh, box_mesh, lathe_parts, ring_parts, transform_mesh

NUM_SIDES = 16
"""Number of corners of polygons that approximate circles."""
NUM_WALL_PARTS = 10
"""Number of convex segments of a hollow wall."""

Profile = Sequence[tuple[float, float]]
"""Radii and heights of the corners of a profile, from the bottom to the top, metres."""


def vessel(profile: Profile, wall_m: float, bottom_m: float) -> list[Mesh]:
    """Return a hollow solid of revolution with a bottom and an open top.

    The heights of the profile, its outer surface, increase strictly.
    """
    (radius, z), (next_radius, next_z) = profile[0], profile[1]
    inside = radius + (next_radius - radius) * bottom_m / (next_z - z)
    walls = [
        part
        for (low, z0), (high, z1) in pairwise(profile)
        for part in ring_parts(
            [(low - wall_m, z0), (low, z0), (high, z1), (high - wall_m, z1)], NUM_WALL_PARTS
        )
    ]
    return lathe_parts([(radius, z), (inside, z + bottom_m)], NUM_WALL_PARTS) + walls


def box(size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0)) -> Mesh:
    """Return a box with its edge lengths and the position of its centre, metres."""
    return transform_mesh(box_mesh(size), at)


def mug(radius_m: float, height_m: float) -> list[Mesh]:
    """Return a mug whose handle leaves space for a finger."""
    grip_x, top, bottom = radius_m + 0.022, 0.8 * height_m, 0.25 * height_m
    bar = 0.008
    return [
        *vessel([(radius_m, 0.0), (radius_m, height_m)], 0.005, 0.006),
        box((bar, bar, top - bottom + bar), (grip_x, 0, (top + bottom) / 2)),
        *(box((0.022, bar, bar), (radius_m + 0.011, 0, z)) for z in (top, bottom)),
    ]


def spoon() -> list[Mesh]:
    """Return a spoon with a cylindrical handle and an oval bowl."""
    oval = _ring(0.02, NUM_SIDES) * (1.3, 1.0, 1.0)
    tip = np.array([0.065, 0.0, 0.0])
    deep = np.array([0.0, 0.0, 0.009])
    bowl = convex_hull(np.concatenate([oval + tip + deep, 0.7 * oval + tip - deep]))
    ring = _ring(0.009, 8)[:, [2, 0, 1]]
    ends = np.array([[[-0.055, 0.0, 0.0]], [[0.05, 0.0, 0.0]]])
    handle = convex_hull((ring + ends).reshape(-1, 3))
    return [transform_mesh(part, (0, 0, 0), np.pi / 2) for part in (handle, bowl)]


def banana() -> list[Mesh]:
    """Return a banana: four tapered segments along an arc."""
    rings = []
    angles, radii = np.linspace(-0.75, 0.75, 5).tolist(), (0.008, 0.015, 0.017, 0.015, 0.007)
    for angle, radius in zip(angles, radii, strict=True):
        ring = _ring(radius, 8)[:, [0, 2, 1]]  # in the plane of x and z
        cos, sin = math.cos(angle), math.sin(angle)
        rotated = ring @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        rings.append(rotated + np.array([0.065 * cos - 0.065, 0.065 * sin, 0]))
    return [convex_hull(np.concatenate(ends)) for ends in pairwise(rings)]


ITEMS: dict[str, Callable[[], Sequence[Mesh]]] = {
    "bottle": lambda: lathe_parts(
        [(0.023, 0.0), (0.025, 0.004), (0.025, 0.07), (0.011, 0.092), (0.011, 0.115)]
    ),
    "flask": lambda: lathe_parts([(0.026, 0.0), (0.026, 0.03), (0.012, 0.055), (0.014, 0.08)]),
    "can": lambda: lathe_parts([(0.024, 0.0), (0.026, 0.003), (0.026, 0.077), (0.024, 0.08)]),
    "jar": lambda: lathe_parts([(0.027, 0.0), (0.027, 0.045), (0.022, 0.05), (0.022, 0.062)]),
    "mug": lambda: mug(0.028, 0.07),
    "espresso cup": lambda: mug(0.024, 0.045),
    "tumbler": lambda: vessel([(0.021, 0.0), (0.028, 0.08)], 0.004, 0.006),
    "bowl": lambda: vessel([(0.018, 0.0), (0.028, 0.014), (0.03, 0.04)], 0.004, 0.005),
    "plate": lambda: vessel([(0.028, 0.0), (0.031, 0.022)], 0.004, 0.005),
    "tea box": lambda: [box((0.05, 0.075, 0.03))],
    "carton": lambda: [box((0.045, 0.045, 0.095))],
    "soap": lambda: [box((0.05, 0.08, 0.025))],
    "brick": lambda: [box((0.04, 0.09, 0.04))],
    "bar": lambda: [box((0.022, 0.11, 0.022))],
    "spoon": spoon,
    "brush": lambda: [
        box((0.02, 0.1, 0.018), (0, -0.02, 0)),
        box((0.03, 0.055, 0.026), (0, 0.055, -0.004)),
    ],
    "hammer": lambda: [
        box((0.018, 0.1, 0.018), (0, -0.03, 0)),
        box((0.065, 0.024, 0.024), (0, 0.03, 0)),
    ],
    "banana": banana,
    "lemon": lambda: lathe_parts(
        [(0.004, -0.034), (0.018, -0.022), (0.025, 0.0), (0.018, 0.022), (0.004, 0.034)]
    ),
    "cheese": lambda: [
        convex_hull(np.array([(x, y, z) for x, y in _CHEESE_BASE for z in (-0.018, 0.018)]))
    ],
}
_CHEESE_BASE = ((-0.035, -0.025), (-0.035, 0.025), (0.045, 0.0))


@OBJECT_SETS.register("household")
class Household(ObjectSet):
    """Bottles, cups, bowls, boxes and tools that a two-finger gripper can grasp."""

    @property
    def names(self) -> Sequence[str]:
        """Names of the items."""
        return list(ITEMS)

    def parts(self, index: int) -> tuple[Mesh, ...]:
        return tuple(list(ITEMS.values())[index]())


def _ring(radius_m: float, corners: int) -> np.ndarray:
    """Return points [corners, 3] on a horizontal circle about the origin."""
    angles = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    return radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(corners)], axis=1)
