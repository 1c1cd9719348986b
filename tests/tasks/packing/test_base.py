"""What the packing tasks share: containers, sizes, numbers of objects."""

import numpy as np
import pytest

import ba_torchrl
from ba_torchrl.errors import ConfigError
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.open_loop.bin_packing import object_shapes
from ba_torchrl.tasks.open_loop.bottle_arrangement import BOTTLES_CM
from ba_torchrl.tasks.packing.base import open_box
from tests.tasks.packing.scenes import BIN, BOTTLES, BOXES


def test_objects_have_the_papers_sizes():
    for shape in object_shapes(1.0).values():
        size = np.ptp(shape.vertices, axis=0)
        assert (size >= (0.0395, 0.0395, 0.0195)).all()
        assert (size <= (0.0405, 0.0805, 0.0405)).all()
    assert len(object_shapes(1.0)) == 7
    for profile in BOTTLES_CM.values():
        assert 2 * max(r for r, _ in profile) <= 5.0
        assert 13.0 <= profile[-1][1] <= 14.5
    assert len(BOTTLES_CM) == 8


def test_an_open_box_holds_objects():
    with World() as world:
        size, wall, floor = (0.2, 0.1, 0.08), 0.004, 0.004
        box = world.add(open_box(size, wall, floor, (1.0, 1.0, 1.0, 1.0)), "box")
        box.place((0.0, 0.0, size[2] / 2))
        ball = world.add(object_shapes(1.0)["cube"], "cube")
        for x, y, z in ((0.0, 0.0, floor), (0.075, -0.025, floor), (0.2, 0.0, 0.0)):
            ball.place((x, y, 0.15))
            assert world.settle(400)
            assert ball.position == pytest.approx((x, y, z + 0.02), abs=1e-3)
        ball.place((0.098, 0.0, 0.11))  # its centre over a wall, which it must not pass through
        world.step(30)
        assert ball.position[2] > 0.08


@pytest.mark.parametrize(
    ("task", "number"), [(BIN, 11), (BOTTLES, 5), (BOXES, 7), (BOXES, 24), (BOXES, 1)]
)
def test_unsupported_numbers_of_objects_are_refused(task, number):
    with pytest.raises(ConfigError, match="num_objects"):
        ba_torchrl.make(task, num_objects=number)
