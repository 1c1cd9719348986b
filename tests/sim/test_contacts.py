"""Contacts and distances of boxes with known forces and gaps."""

import math

import pytest

from ba_torchrl.sim.contacts import (
    contacts,
    gap_m,
    is_any_within,
    lateral_force_n,
    nearest_points,
    outer_contacts,
    vertical_force_n,
)
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World

EDGE_M, MASS_KG, GRAVITY_M_S2 = 0.05, 0.1, 10.0


@pytest.fixture
def world():
    with World() as world:
        yield world


@pytest.fixture
def stack(world):
    """Return two stacked cubes at rest on the floor."""
    shape = Box(size_m=(EDGE_M,) * 3, mass_kg=MASS_KG)
    low, high = world.add(shape, "low"), world.add(shape, "high")
    low.place((0.4, 0.0, EDGE_M / 2))
    high.place((0.4, 0.0, 1.5 * EDGE_M))
    world.step(120)
    return low, high


def test_normal_and_force_of_a_body_on_another(world, stack):
    low, high = stack
    touching = contacts(world.client, high.id, low.id)
    assert {(point.body_id, point.other_id) for point in touching} == {(high.id, low.id)}
    assert all(point.normal[2] == pytest.approx(1.0, abs=1e-3) for point in touching)
    assert vertical_force_n(touching) == pytest.approx(MASS_KG * GRAVITY_M_S2, rel=0.02)
    assert lateral_force_n(touching) == 0
    from_below = contacts(world.client, low.id, high.id)
    assert all(point.normal[2] == pytest.approx(-1.0, abs=1e-3) for point in from_below)


def test_contacts_lists_all_other_bodies(world, stack):
    low, high = stack
    others = {point.other_id for point in contacts(world.client, low.id)}
    assert others == {world.floor, high.id}


def test_outer_contacts_omits_contacts_within_the_group(world, stack):
    low, high = stack
    outer = outer_contacts(world.client, low.id, high.id)
    assert {(point.body_id, point.other_id) for point in outer} == {(low.id, world.floor)}
    assert vertical_force_n(outer) == pytest.approx(2 * MASS_KG * GRAVITY_M_S2, rel=0.02)
    assert outer_contacts(world.client, low.id) == contacts(world.client, low.id)


def test_force_of_a_wall_is_lateral(world):
    cube = world.add(Box(size_m=(EDGE_M,) * 3, mass_kg=MASS_KG), "cube")
    wall = world.add(Box(size_m=(0.02, 0.2, 0.2), mass_kg=0.0), "wall")
    cube.place((0.4, 0.0, EDGE_M / 2))
    wall.place((0.4 + EDGE_M / 2 + 0.01 - 1e-3, 0.0, 0.1))  # penetrates the cube by a millimetre
    world.step()
    touching = contacts(world.client, cube.id, wall.id)
    assert lateral_force_n(touching) > 0
    assert vertical_force_n(touching) == 0
    assert not any(point.is_vertical for point in touching)


@pytest.mark.parametrize("gap", [-0.002, 0.003, 0.08])
def test_gap_and_nearest_points(world, gap):
    shape = Box(size_m=(EDGE_M,) * 3)
    first, second = world.add(shape, "first"), world.add(shape, "second")
    first.place((0.4, 0.0, EDGE_M / 2))
    second.place((0.4, EDGE_M + gap, EDGE_M / 2))
    assert gap_m(world.client, first.id, second.id) == pytest.approx(gap, abs=1e-4)
    assert gap_m(world.client, first.id, second.id, up_to_m=0.05) == (
        pytest.approx(gap, abs=1e-4) if gap < 0.05 else math.inf
    )
    points = nearest_points(world.client, first.id, second.id, 0.1, link=-1)
    assert {point.link for point in points} == {-1}
    assert is_any_within(points, gap + 1e-3)
    assert not is_any_within(points, gap - 1e-3)
