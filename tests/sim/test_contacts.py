"""Contacts and distances of boxes whose forces and gaps are known."""

import math
import re
from pathlib import Path

import pytest

import ba_torchrl
from ba_torchrl.sim.contacts import (
    bearing_force_n,
    contacts,
    gap_m,
    is_any_within,
    lateral_force_n,
    nearest_points,
    outer_contacts,
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
    """Two cubes on top of each other, at rest on the floor."""
    shape = Box(size_m=(EDGE_M,) * 3, mass_kg=MASS_KG)
    low, high = world.add(shape, "low"), world.add(shape, "high")
    low.place((0.4, 0.0, EDGE_M / 2))
    high.place((0.4, 0.0, 1.5 * EDGE_M))
    world.step(120)
    return low, high


def test_a_body_bears_on_what_it_lies_on(world, stack):
    low, high = stack
    touching = contacts(world.client, high.id, low.id)
    assert {(point.body_id, point.other_id) for point in touching} == {(high.id, low.id)}
    assert all(point.normal[2] == pytest.approx(1.0, abs=1e-3) for point in touching)
    assert bearing_force_n(touching) == pytest.approx(MASS_KG * GRAVITY_M_S2, rel=0.02)
    assert lateral_force_n(touching) == 0
    from_below = contacts(world.client, low.id, high.id)
    assert all(point.normal[2] == pytest.approx(-1.0, abs=1e-3) for point in from_below)


def test_all_contacts_of_a_body(world, stack):
    low, high = stack
    others = {point.other_id for point in contacts(world.client, low.id)}
    assert others == {world.floor, high.id}


def test_contacts_inside_a_group_do_not_count(world, stack):
    low, high = stack
    outer = outer_contacts(world.client, low.id, high.id)
    assert {(point.body_id, point.other_id) for point in outer} == {(low.id, world.floor)}
    assert bearing_force_n(outer) == pytest.approx(2 * MASS_KG * GRAVITY_M_S2, rel=0.02)
    assert outer_contacts(world.client, low.id) == contacts(world.client, low.id)


def test_a_wall_presses_from_the_side(world):
    cube = world.add(Box(size_m=(EDGE_M,) * 3, mass_kg=MASS_KG), "cube")
    wall = world.add(Box(size_m=(0.02, 0.2, 0.2), mass_kg=0.0), "wall")
    cube.place((0.4, 0.0, EDGE_M / 2))
    wall.place((0.4 + EDGE_M / 2 + 0.01 - 1e-3, 0.0, 0.1))  # a millimetre inside of the cube
    world.step()
    touching = contacts(world.client, cube.id, wall.id)
    assert lateral_force_n(touching) > 0
    assert bearing_force_n(touching) == 0
    assert not any(point.is_vertical for point in touching)


@pytest.mark.parametrize("gap", [-0.002, 0.003, 0.08])
def test_gaps(world, gap):
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


def test_no_other_file_of_the_package_reads_contacts():
    files = sorted(Path(ba_torchrl.__file__).parent.rglob("*.py"))
    queries = r"getContactPoints|getClosestPoints"
    found = {path.name for path in files if re.search(queries, path.read_text("utf-8"))}
    assert found == {"contacts.py"}
