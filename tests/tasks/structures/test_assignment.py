"""Which arrangements of pieces fill the slots of a blueprint."""

import itertools
import math

import pytest

from ba_torchrl.sim.bodies import vertical_extent
from ba_torchrl.sim.shapes import Box
from ba_torchrl.tasks.structures.blueprint import tower
from ba_torchrl.tasks.structures.pieces import CUBE, TRIANGLE
from tests.tasks.structures.scenes import BRIDGE, B, rotate


def test_a_stack_tolerates_offsets_below_half_a_block(scene):
    s = scene(tower(CUBE, CUBE))
    lower, upper = s.cubes
    for dx, dy, expected in (
        (0.0, 0.0, True),
        (0.014, -0.014, True),
        (0.016, 0.0, False),
        (0.0, -0.016, False),
    ):
        s.put(lower, 0.4, 0.0, 0)
        s.put(upper, 0.4 + dx, dy, 1, yaw=0.4)
        s.world.step()
        assert s.is_built() is expected, (dx, dy)


def test_a_stack_needs_contact_and_an_empty_gripper(scene):
    s = scene(tower(CUBE, CUBE, CUBE))
    for order in itertools.permutations(s.cubes):
        for level, cube in enumerate(order):
            s.put(cube, 0.4, 0.0, level)
        s.world.step()
        assert s.is_built()
        assert not any(s.is_built(held=cube) for cube in s.cubes)
    top = order[2]
    top.place((0.4, 0.0, 2.5 * B + 0.003))
    s.world.step()
    assert not s.is_built()
    for level in (1, 0):  # beside the second, without a support; beside the first
        s.put(top, 0.4 + B, 0.0, level)
        s.world.step()
        assert not s.is_built()


def test_the_triangle_must_be_upright_on_top(scene):
    s = scene(tower(CUBE, CUBE, TRIANGLE))
    first, second = s.cubes
    triangle = s.bodies["triangle"][0]
    s.put(first, 0.4, 0.0, 0)
    s.put(second, 0.4, 0.0, 1)
    s.settle()
    assert not s.is_built()  # the triangle is on the floor
    s.put(triangle, 0.4, 0.0, 2, yaw=1.0)
    s.settle()
    assert s.is_built()
    assert s.next_move() is None
    # on its slope, with the centre unchanged
    slope = math.pi - math.atan2(B, B / 2)
    rotate(triangle, (0.0, 1.0, 0.0), slope, 0.0)
    depth = triangle.position[2] - vertical_extent(triangle)[0]
    triangle.set_pose((0.4, 0.0, 2 * B + depth), triangle.pose[1])
    s.settle()
    assert triangle.touches(second)
    assert not s.is_built()
    s.put(triangle, 0.4, 0.0, 1)
    s.put(second, 0.5, 0.1, 0)
    s.settle()
    assert not s.is_built()  # the triangle is one level too low


def bridge_scene(scene, roof_offset, spacing, bearing=0.6):
    s = scene(BRIDGE)
    c, sn = math.cos(bearing), math.sin(bearing)
    for cube, side in zip(s.cubes, (-0.5, 0.5), strict=True):
        s.put(cube, 0.45 + side * spacing * c, side * spacing * sn, 0, yaw=bearing)
    roof = s.bodies["roof"][0]
    s.put(roof, 0.45 + roof_offset * c, roof_offset * sn, 1, yaw=bearing - math.pi / 2)
    s.world.step()
    return s, roof


@pytest.mark.parametrize(
    ("offset", "spacing", "expected"),
    [
        (0.0, 1.75 * B, True),
        (0.029, 1.75 * B, True),
        (0.031, 1.75 * B, False),  # by more than one block
        (2.6 * B, 1.75 * B, False),
        (0.0, 5.2 * B, False),  # cubes too far apart
    ],
)
def test_a_roof_on_both_cubes_is_a_bridge(scene, offset, spacing, expected):
    s, roof = bridge_scene(scene, offset, spacing)
    assert s.is_built() is expected
    assert not s.is_built(held=roof)


def test_a_top_slot_must_stay_free(scene):
    s = scene(tower(CUBE, CUBE), cube=1)
    for level, cube in enumerate(s.cubes):
        s.put(cube, 0.4, 0.0, level)
    s.settle()
    assert not s.is_built()
    (move,) = s.play()
    assert move.body is s.cubes[2]
    assert move.onto == ()
    assert s.is_built()
    # also a piece that the structure does not need must be released
    assert s.assigner(held=s.cubes[2]).evaluate() == {"is_released": False, "is_built": True}


def test_the_support_can_be_another_body_than_the_floor(scene):
    s = scene(tower(CUBE, CUBE))
    platform = s.world.add(Box(size_m=(0.2, 0.2, 0.02), mass_kg=0.0), "platform")
    platform.place((0.45, 0.0, 0.01))
    s.ground = frozenset({platform.id})
    for x, base, expected in ((0.7, 0.0, False), (0.45, 0.02, True)):
        for level, cube in enumerate(s.cubes):
            cube.place((x, 0.0, base + (level + 0.5) * B))
        s.world.step()
        assert s.is_built() is expected
