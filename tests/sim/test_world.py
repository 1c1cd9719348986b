from pathlib import Path

import pybullet
import pytest

import ba_torchrl
from ba_torchrl.core.errors import SimulationError
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World


def test_worlds_are_independent():
    with World() as first, World() as second:
        a = first.add(Box(size_m=(0.05, 0.05, 0.05)), "a")
        b = second.add(Box(size_m=(0.05, 0.05, 0.05)), "b")
        a.place((0, 0, 1.0))
        b.place((0, 0, 1.0))
        first.step(10)
        assert a.position[2] < 1.0
        assert b.position[2] == 1.0


def test_static_bodies_are_at_rest():
    with World() as world:
        shapes = [Box(size_m=(0.05, 0.05, 0.05), mass_kg=mass) for mass in (0.0, 0.1)]
        static, moving = (world.add(shape, "box") for shape in shapes)
        assert world.moving_bodies == [moving]
        for body, is_still in ((static, True), (moving, False)):
            pybullet.resetBaseVelocity(body.id, (1.0, 0, 0), physicsClientId=world.client)
            assert world.is_still() == is_still


def test_the_world_is_still_when_no_visible_body_moves():
    with World() as world:
        bodies = [world.add(Box(size_m=(0.05, 0.05, 0.05)), f"{i}") for i in range(3)]

        def push(*speeds_m_s):
            for body, speed in zip(bodies, speeds_m_s, strict=True):
                pybullet.resetBaseVelocity(body.id, (speed, 0, 0), physicsClientId=world.client)
            return world.is_still()

        assert push(0.0, 0.0, 0.0)
        assert not push(0.0, 0.0, 1.0)
        assert not push(0.0, 1.0, 1.0)
        assert not push(1.0, 0.0, 0.0)
        bodies[0].is_hidden = True
        assert world.is_still()
        bodies[0].is_hidden = False
        assert not world.is_still()
        assert push(0.0, 0.0, 0.0)


def test_settle_returns_whether_bodies_came_to_rest():
    with World() as world:
        box = world.add(Box(size_m=(0.05, 0.05, 0.05)), "box")
        box.place((0, 0, 0.025))
        assert world.settle()
        box.place((0, 0, 50.0))
        before = world.steps
        assert not world.settle(max_steps=20)
        assert world.steps - before == 20


def test_bodies_with_fixed_poses_cannot_move():
    with World() as world:
        body = world.add(Box(size_m=(0.05, 0.05, 0.05)), "box")
        body.place((0.4, 0.1, 1.0), 0.3)
        world.seal()
        pose = body.pose
        with world.fixed_poses():
            assert body.pose is body.pose
            assert body.pose == pose
            for move in (world.step, world.restore_pristine, lambda: body.place((0.0, 0.0, 1.0))):
                with pytest.raises(RuntimeError, match="fixed"):
                    move()
            with pytest.raises(RuntimeError, match="fixed"), world.fixed_poses():
                pass
            assert body.pose is body.pose
        world.step(5)
        assert body.position[2] < pose.position[2]


def test_poses_are_not_fixed_after_an_error():
    with World() as world:
        body = world.add(Box(size_m=(0.05, 0.05, 0.05)), "box")
        with pytest.raises(ZeroDivisionError), world.fixed_poses():
            _ = 1 / 0
        body.place((0.4, 0.1, 1.0))
        world.step()


def test_closing_or_deleting_a_world_disconnects_its_client():
    world = World()
    client = world.client
    world.close()
    world.close()
    assert world.is_closed
    assert not pybullet.isConnected(physicsClientId=client)
    client = World().client
    assert not pybullet.isConnected(physicsClientId=client)


def test_bodies_are_added_before_seal_and_restored_after_it():
    with World() as world:
        with pytest.raises(SimulationError, match="seal"):
            world.restore_pristine()
        world.seal()
        with pytest.raises(SimulationError, match="sealed"):
            world.add(Box(size_m=(0.05, 0.05, 0.05)), "late")


def test_touches_detects_contact():
    with World() as world:
        a, b = (world.add(Box(size_m=(0.05, 0.05, 0.05)), n) for n in "ab")
        a.place((0, 0, 0.025))
        for gap, expected in ((0.002, False), (0.0, True)):
            b.place((0.05 + gap, 0, 0.025))
            world.step(2)
            assert a.touches(b) is expected


def resident_mb():
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_resets_do_not_leak_memory_or_bodies():
    env = ba_torchrl.make("close_loop/block_pushing", obs_size=16)
    for _ in range(200):
        env.reset()
    before = resident_mb()
    bodies = pybullet.getNumBodies(physicsClientId=env.scene.world.client)
    for _ in range(1000):
        env.reset()
    assert resident_mb() - before < 5
    assert pybullet.getNumBodies(physicsClientId=env.scene.world.client) == bodies
    env.close()


def test_a_snapshot_of_a_closed_world_is_restored_in_the_next():
    first = World()
    first.seal()
    snapshot = first.snapshot()
    first.close()
    with World() as second:  # it has the same client id
        second.seal()
        assert second.client == first.client
        second.restore(snapshot)
        del snapshot, first
        second.restore_pristine()
