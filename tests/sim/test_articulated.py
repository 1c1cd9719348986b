import math

import numpy as np
import pybullet
import pytest

from ba_torchrl.errors import SimulationError
from ba_torchrl.sim.articulated import Rail
from ba_torchrl.sim.meshes import box_mesh, moved, rod_mesh
from ba_torchrl.sim.robots.kuka import Kuka
from ba_torchrl.sim.shapes import Box, Solid
from ba_torchrl.sim.vision.depth import HeightCamera
from ba_torchrl.sim.world import World

RAIL = Rail(range_m=(0.0, 0.2), friction_n=3.0)


def add_box(world, rail=RAIL, **slider):
    """A plate with a 10 cm box on it that slides along the plate's x axis."""
    plate = Box(size_m=(0.3, 0.3, 0.02), mass_kg=0.0)
    box = Solid(
        parts=(moved(box_mesh((0.1, 0.1, 0.1)), (0.0, 0.0, 0.07)),),
        **{"mass_kg": 0.5, **slider},
    )
    return world.add_articulated(plate, box, rail, "plate")


def push(world, body, force_n, steps):
    for _ in range(steps):
        pybullet.applyExternalForce(
            body.id,
            0,
            (force_n, 0, 0),
            (0, 0, 0),
            pybullet.LINK_FRAME,
            physicsClientId=world.client,
        )
        world.step()


def test_the_slider_goes_with_the_base_and_along_the_rail():
    with World() as world:
        body = add_box(world)
        body.place((0.4, 0.1, 0.01), math.pi / 2, travel_m=0.15)
        assert body.travel_m == pytest.approx(0.15)
        np.testing.assert_allclose(body.base.position, (0.4, 0.1, 0.01), atol=1e-6)
        np.testing.assert_allclose(body.slider.position, (0.4, 0.25, 0.01), atol=1e-6)
        assert body.slider.yaw_rad == pytest.approx(math.pi / 2)
        low, high = body.slider.bounding_box()
        np.testing.assert_allclose(low, (0.35, 0.2, 0.03), atol=2e-3)
        np.testing.assert_allclose(high, (0.45, 0.3, 0.13), atol=2e-3)
        world.step(20)
        assert body.travel_m == pytest.approx(0.15, abs=1e-6)
        np.testing.assert_allclose(body.base.position, (0.4, 0.1, 0.01), atol=1e-6)


def test_friction_holds_until_it_is_overcome_and_stops_the_slider():
    with World() as world:
        body = add_box(world)
        push(world, body, 2.9, 60)
        assert body.travel_m == pytest.approx(0.0, abs=1e-5)
        push(world, body, 4.0, 12)
        # (4 N - 3 N) / 0.5 kg for 0.1 s
        assert body.travel_m == pytest.approx(0.5 * 2.0 * 0.1**2, rel=0.15)
        speed = pybullet.getJointState(body.id, 0, physicsClientId=world.client)[1]
        assert speed == pytest.approx(0.2, rel=0.1)
        assert not world.is_still()
        before = body.travel_m
        assert world.settle(20)
        assert body.travel_m - before == pytest.approx(0.2**2 / (2 * 6.0), rel=0.3)


@pytest.mark.parametrize(("force_n", "end_m"), [(150.0, 0.2), (-150.0, 0.0)])
def test_the_rail_ends(force_n, end_m):
    with World() as world:
        body = add_box(world)
        body.place((0.0, 0.0, 0.01), travel_m=0.1)
        push(world, body, force_n, 60)
        assert body.travel_m == pytest.approx(end_m, abs=2e-3)


def test_a_slider_pushed_past_the_end_comes_back():
    with World() as world:
        body = add_box(world)
        pybullet.resetJointState(body.id, 0, -0.01, physicsClientId=world.client)
        world.step(60)
        assert body.travel_m > -1e-3


def test_a_restored_world_has_the_slider_where_it_was_and_the_same_future():
    with World() as world:
        body = add_box(world)
        world.seal()
        body.place((0.1, 0.2, 0.01), 0.3, travel_m=0.05)
        push(world, body, 5.0, 10)
        kept, travel, pose = world.snapshot(), body.travel_m, body.slider.pose
        push(world, body, 5.0, 10)
        after = body.travel_m
        world.restore(kept)
        assert body.travel_m == travel
        assert body.slider.pose == pose
        push(world, body, 5.0, 10)
        assert body.travel_m == after
        world.restore_pristine()
        assert body.travel_m == 0.0


def test_cameras_see_both_parts_where_they_are():
    with World() as world:
        body = add_box(world)
        camera = HeightCamera(world.bodies)
        for travel in (0.0, 0.12):
            body.place((0.0, 0.0, 0.01), travel_m=travel)
            image = camera.heightmap((0.1, 0.0), 0.6, 60)
            xs = (np.arange(60) + 0.5) * 0.01 - 0.2
            ys = (np.arange(60) + 0.5) * 0.01 - 0.3
            expected = np.zeros((60, 60))
            expected[np.ix_(abs(xs) < 0.15, abs(ys) < 0.15)] = 0.02
            expected[np.ix_(abs(xs - travel) < 0.05, abs(ys) < 0.05)] = 0.13
            np.testing.assert_allclose(image, expected, atol=1e-6)


def test_contacts_tell_the_parts_apart():
    with World() as world:
        body = add_box(world)
        block = world.add(Box(size_m=(0.03, 0.03, 0.03)), "block")
        block.place((0.12, 0.0, 0.035))
        world.step(5)
        assert body.base.touches(block)
        assert not body.slider.touches(block)
        block.place((0.0, 0.0, 0.145))
        world.step(5)
        assert body.slider.touches(block)
        assert not body.base.touches(block)


def test_a_squeezed_slider_is_not_held():
    with World() as world:
        robot = Kuka(world)
        rod = Solid(parts=(moved(rod_mesh(0.1, 0.02), (0.0, 0.0, 0.1)),), mass_kg=0.5, friction=1.0)
        base = Box(size_m=(0.05, 0.05, 0.02), mass_kg=0.0)
        body = world.add_articulated(base, rod, RAIL, "rod")
        body.place((0.45, 0.0, 0.01))
        down = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
        robot.teleport(robot.inverse_kinematics((0.45, 0.0, 0.11), down))
        robot.set_opening(0.3)
        robot.hold_opening(0.0)
        world.step(30)
        points = pybullet.getContactPoints(robot.id, body.id, physicsClientId=world.client)
        fingers = {point[3] for point in points}
        assert all(fingers & links for links in robot.finger_links)
        assert robot.held_body() is None


def test_parts_refuse_what_the_rail_forbids():
    with World() as world:
        body = add_box(world)
        with pytest.raises(ValueError, match="rail"):
            body.slider.place((0.0, 0.0, 0.0))
        with pytest.raises(ValueError, match="outside"):
            body.place((0.0, 0.0, 0.0), travel_m=0.3)
        with pytest.raises(ValueError, match="mass"):
            add_box(world, mass_kg=0.0)
        world.seal()
        with pytest.raises(SimulationError, match="sealed"):
            add_box(world)
    with pytest.raises(ValueError, match="contain 0"):
        Rail(range_m=(0.1, 0.2), friction_n=1.0)
    with pytest.raises(ValueError, match="negative"):
        Rail(range_m=(0.0, 0.2), friction_n=-1.0)
