"""Bodies that are kept aside."""

import pytest

from ba_torchrl.sim.contacts import contacts
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.body_pool import BodyPool


def make_pool(world, mass_kg):
    shapes = [Box(size_m=(0.2, 0.2, 0.05), mass_kg=mass_kg)] * 12
    return BodyPool(world, shapes, [f"{mass_kg} kg, {i}" for i in range(12)])


def test_inactive_bodies_fall_freely_beside_inactive_static_ones():
    with World() as world:
        static, moving = make_pool(world, 0.0), make_pool(world, 0.1)
        heights = [body.position[2] for body in moving.bodies]
        world.step(12)
        assert not any(contacts(world.client, body.id) for body in static.bodies)
        fall_m = world.physics.gravity_m_s2 * 0.1**2 / 2
        for body, height in zip(moving.bodies, heights, strict=True):
            assert height - body.position[2] == pytest.approx(fall_m, rel=0.1)


def test_a_body_is_visible_while_it_is_active():
    with World() as world:
        pool = make_pool(world, 0.1)
        assert all(body.is_hidden for body in pool.bodies)
        pool.activate(pool.bodies[3])
        assert pool.active == [pool.bodies[3]]
        assert [body.is_hidden for body in pool.bodies].count(False) == 1
        assert pool.get_state() == (3,)
        pool.deactivate(pool.bodies[3])
        assert pool.active == []
        assert pool.bodies[3].is_hidden
