"""The household items at rest on the ground."""

import math

import numpy as np
import pybullet

from ba_torchrl.sim.assets.base import load_object_set
from ba_torchrl.sim.assets.household import ITEMS
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World


def test_hollow_items_hold_a_small_object():
    shapes = load_object_set("household")
    for name in ("mug", "tumbler", "bowl"):
        shape = shapes[shapes.names.index(name)]
        with World() as world:
            vessel = world.add(shape, name)
            vessel.place((0.0, 0.0, -shape.bounds_m[0][2]))
            cube = world.add(Box(size_m=(0.012, 0.012, 0.012), mass_kg=0.01), "cube")
            cube.place((0.0, 0.0, 0.5 * shape.height_m))
            assert world.settle(400)
            assert 0.009 < cube.position[2] < 0.016  # on the bottom
            assert math.hypot(*cube.position[:2]) < 0.02
            assert vessel.tilt_rad < 0.1


def test_every_item_comes_to_rest_on_the_floor():
    shapes = load_object_set("household")
    with World() as world:
        for i, (name, shape) in enumerate(zip(shapes.names, shapes, strict=True)):
            world.add(shape, name).place((0.3 * i, 0.0, 0.005 - shape.bounds_m[0][2]))
        world.step(240)
        for body in world.bodies:
            (_, _, z), turn = body.pose
            matrix = np.reshape(pybullet.getMatrixFromQuaternion(turn), (3, 3))
            lowest = z + (body.shape.mesh().vertices @ matrix.T)[:, 2].min()
            assert abs(lowest) < 1.5e-3, body.name
    assert list(ITEMS) == list(shapes.names)
