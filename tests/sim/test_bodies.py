"""The bounding box of a body."""

import math

import numpy as np
import pytest

from ba_torchrl.sim.bodies import MAX_FRAMES, planar_extents, vertical_extent, world_vertices
from ba_torchrl.sim.geometry import PlanarFrame
from ba_torchrl.sim.meshes import box_mesh, transform_mesh
from ba_torchrl.sim.shapes import Box, Solid
from ba_torchrl.sim.world import World

SIZE = (0.2, 0.04, 0.06)
HULL = Solid(parts=(box_mesh(SIZE),))
COMPOUND = Solid(
    parts=tuple(transform_mesh(box_mesh((0.1, 0.04, 0.06)), (x, 0.0, 0.0)) for x in (-0.05, 0.05))
)


@pytest.mark.parametrize("shape", [Box(size_m=SIZE), HULL, COMPOUND], ids=["box", "hull", "parts"])
@pytest.mark.parametrize("yaw_rad", [0.0, 0.5, math.pi / 4])
def test_the_bounding_box_contains_the_surface_exactly(shape, yaw_rad):
    with World() as world:
        body = world.add(shape, "body")
        body.place((0.4, 0.1, 0.2), yaw_rad)
        low, high = body.bounding_box()
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        half = np.array((cos * SIZE[0] + sin * SIZE[1], sin * SIZE[0] + cos * SIZE[1], SIZE[2])) / 2
        np.testing.assert_allclose(low, body.position - half, atol=1e-6)
        np.testing.assert_allclose(high, body.position + half, atol=1e-6)


def test_extents_along_the_axes_of_a_horizontal_frame():
    """After every motion, and for more frames than are kept."""
    with World() as world:
        body = world.add(Box(size_m=(0.08, 0.03, 0.02)), "box")
        for x in (0.3, 0.5):
            body.place((x, 0.1, 0.2), 0.4)
            vertices = world_vertices(body)
            for yaw in np.linspace(-3.0, 3.0, MAX_FRAMES + 10).tolist():
                axes = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
                local = (vertices[:, :2] - (0.45, -0.1)) @ axes.T
                found = planar_extents(body, PlanarFrame(0.45, -0.1, yaw))
                expected = np.stack([local.min(axis=0), local.max(axis=0)], axis=1)
                np.testing.assert_allclose(found, expected, atol=1e-12)
        assert vertical_extent(body) == (vertices[:, 2].min(), vertices[:, 2].max())
