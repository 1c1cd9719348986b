"""Bodies that are kept aside."""

import pytest

from ba_torchrl.sim.contacts import contacts
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.body_pool import BodyPool


def make_pool(world, mass_kg):
    shapes = [Box(size_m=(0.2, 0.2, 0.05), mass_kg=mass_kg)] * 12
    return BodyPool(world, shapes, [f"{mass_kg} kg, {i}" for i in range(12)])


def test_inactive_bodies_are_not_simulated():
    with World() as world:
        static, moving = make_pool(world, 0.0), make_pool(world, 0.1)
        world.step()
        before = [body.pose for body in moving.bodies]
        world.step(12)
        assert [body.pose for body in moving.bodies] == before
        world.snapshot()  # wakes them for a step
        world.step()
        before = [body.pose for body in moving.bodies]
        world.step(12)
        assert [body.pose for body in moving.bodies] == before
        touching = [contacts(world.client, body.id) for body in static.bodies + moving.bodies]
        assert not any(touching)


def test_an_activated_body_is_simulated():
    with World() as world:
        pool = make_pool(world, 0.1)
        world.step(3)
        body = pool.bodies[3]
        pool.activate(body)
        body.place((0.5, 0.0, 0.3))
        world.step(11)  # it is simulated from the second step on
        fall_m = world.physics.gravity_m_s2 * (10 * world.physics.time_step_s) ** 2 / 2
        assert 0.3 - body.position[2] == pytest.approx(fall_m, rel=0.15)
        assert world.settle()
        assert body.position[2] == pytest.approx(0.025, abs=1e-3)
        pool.deactivate(body)
        world.step()
        height = body.position[2]
        world.step(5)
        assert body.position[2] == height > 1e5


def drop(world, pool):
    """Let a body fall on another one and return their poses after some steps."""
    first, second = pool.bodies[2], pool.bodies[7]
    pool.activate(first)
    first.place((0.5, 0.0, 0.025))
    pool.activate(second)
    second.set_pose((0.51, 0.02, 0.15), (0.1, 0.2, 0.0, 0.9746794344808963))
    poses = []
    for _ in range(60):
        world.step()
        poses += [first.pose, second.pose]
    return poses


def test_the_past_activity_of_bodies_does_not_affect_a_restored_world():
    with World() as world:
        pool = make_pool(world, 0.1)
        world.seal()
        played = []
        for active, steps in [((), 0), ((2,), 4), ((7, 2), 8), ((), 3)]:  # in an earlier episode
            pool.clear()
            for number in active:
                pool.activate(pool.bodies[number])
                pool.bodies[number].place((0.5, 0.3 * number, 0.2))
            world.step(steps)
            world.restore_pristine()
            pool.clear()
            played.append(drop(world, pool))
        assert all(poses == played[0] for poses in played[1:])  # bit for bit


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
