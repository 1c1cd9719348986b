"""Blueprints: which are valid, their optimal steps; tilt and yaw of pieces."""

import math

import pytest

from ba_torchrl.tasks.structures.blueprint import Blueprint, Slot, tower
from ba_torchrl.tasks.structures.pieces import CUBE, CUBOID, ROOF
from tests.tasks.structures.scenes import SPAN, rotate


@pytest.mark.parametrize(
    ("slots", "message"),
    [
        ((Slot(CUBE, on=(0,)),), "after"),
        ((Slot(CUBE, on=(1,)), Slot(CUBE)), "after"),
        ((Slot(CUBE), Slot(CUBE), Slot(ROOF, on=(0, 1))), "span"),
        ((Slot(CUBE), Slot(CUBE, on=(0,), span=SPAN)), "span"),
        ((Slot(CUBE), Slot(CUBE), Slot(CUBE), Slot(ROOF, on=(0, 1, 2), span=SPAN)), "one or two"),
        ((Slot(CUBE), Slot(ROOF, on=(0, 0), span=SPAN)), "one or two"),
        ((Slot(CUBE), Slot(CUBE, on=(0,)), Slot(ROOF, on=(0, 1), span=SPAN)), "the same"),
    ],
)
def test_impossible_blueprints_are_refused(slots, message):
    with pytest.raises(ValueError, match=message):
        Blueprint(slots)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
@pytest.mark.parametrize("angle", [0.0, math.pi / 2, math.pi, -math.pi / 2])
def test_the_yaw_of_a_cube_does_not_depend_on_the_side_that_is_up(scene, axis, angle):
    cube = scene(tower(CUBE)).cubes[0]
    for yaw in (-1.2, 0.3, 2.0):
        # a cube with this yaw, tumbled by quarter turns about its own axes
        rotate(cube, (0.0, 0.0, 1.0), yaw, 0.0)
        c, s = math.cos(yaw), math.sin(yaw)
        own = (axis[0] * c - axis[1] * s, axis[0] * s + axis[1] * c, 0.0)
        rotate(cube, own, angle, yaw)
        assert CUBE.tilt_rad(cube) == pytest.approx(0.0, abs=1e-6)
        difference = (CUBE.yaw_rad(cube) - yaw + math.pi / 4) % (math.pi / 2) - math.pi / 4
        assert difference == pytest.approx(0.0, abs=1e-6)


def test_a_long_piece_on_its_side_is_upright_and_on_its_end_is_tilted(scene):
    cuboid = scene(tower(CUBOID)).bodies["cuboid"][0]
    rotate(cuboid, (0.0, 1.0, 0.0), math.pi / 2, 0.0)  # rolled about its length
    assert CUBOID.tilt_rad(cuboid) == pytest.approx(0.0, abs=1e-6)
    assert CUBOID.yaw_rad(cuboid) == pytest.approx(0.0, abs=1e-6)
    rotate(cuboid, (1.0, 0.0, 0.0), math.pi / 2, 0.0)
    assert CUBOID.tilt_rad(cuboid) == pytest.approx(math.pi / 2)
