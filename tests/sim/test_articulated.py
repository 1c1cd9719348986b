import math

import numpy as np
import pybullet
import pytest

from ba_torchrl.core.errors import SimulationError
from ba_torchrl.sim.articulated import PrismaticJoint
from ba_torchrl.sim.meshes import box_mesh, rod_mesh, transform_mesh
from ba_torchrl.sim.robots.kuka import Kuka
from ba_torchrl.sim.shapes import Box, Solid
from ba_torchrl.sim.vision.depth import HeightCamera
from ba_torchrl.sim.world import World

JOINT = PrismaticJoint(limits_m=(0.0, 0.2), friction_n=3.0)


def add_slider(world, joint=JOINT, **slider):
    """Add a plate with a 10 cm box on it that slides along the x axis of the plate."""
    plate = Box(size_m=(0.3, 0.3, 0.02), mass_kg=0.0)
    box = Solid(
        parts=(transform_mesh(box_mesh((0.1, 0.1, 0.1)), (0.0, 0.0, 0.07)),),
        **{"mass_kg": 0.5, **slider},
    )
    return world.add_articulated(plate, box, joint, "plate")


def push_slider(world, body, force_n, steps):
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


def test_place_sets_base_pose_and_joint_position():
    with World() as world:
        body = add_slider(world)
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


def test_dry_friction_resists_motion_and_stops_the_slider():
    with World() as world:
        body = add_slider(world)
        push_slider(world, body, 2.9, 60)
        assert body.travel_m == pytest.approx(0.0, abs=1e-5)
        push_slider(world, body, 4.0, 12)
        # (4 N - 3 N) / 0.5 kg for 0.1 s
        assert body.travel_m == pytest.approx(0.5 * 2.0 * 0.1**2, rel=0.15)
        speed = pybullet.getJointState(body.id, 0, physicsClientId=world.client)[1]
        assert speed == pytest.approx(0.2, rel=0.1)
        assert not world.is_still()
        before = body.travel_m
        assert world.settle(20)
        assert body.travel_m - before == pytest.approx(0.2**2 / (2 * 6.0), rel=0.3)


@pytest.mark.parametrize(("force_n", "end_m"), [(150.0, 0.2), (-150.0, 0.0)])
def test_joint_limits_stop_the_slider(force_n, end_m):
    with World() as world:
        body = add_slider(world)
        body.place((0.0, 0.0, 0.01), travel_m=0.1)
        push_slider(world, body, force_n, 60)
        assert body.travel_m == pytest.approx(end_m, abs=2e-3)


def test_a_slider_beyond_its_joint_limit_returns():
    with World() as world:
        body = add_slider(world)
        pybullet.resetJointState(body.id, 0, -0.01, physicsClientId=world.client)
        world.step(60)
        assert body.travel_m > -1e-3


def test_restore_resets_the_joint_and_repeats_the_trajectory():
    with World() as world:
        body = add_slider(world)
        world.seal()
        body.place((0.1, 0.2, 0.01), 0.3, travel_m=0.05)
        push_slider(world, body, 5.0, 10)
        snapshot, travel, pose = world.snapshot(), body.travel_m, body.slider.pose
        push_slider(world, body, 5.0, 10)
        after = body.travel_m
        world.restore(snapshot)
        assert body.travel_m == travel
        assert body.slider.pose == pose
        push_slider(world, body, 5.0, 10)
        assert body.travel_m == after
        world.restore_pristine()
        assert body.travel_m == 0.0


def test_only_the_sliding_link_moves():
    with World() as world:
        body = add_slider(world)
        assert world.moving_bodies == [body.slider]


def test_heightmap_shows_both_links():
    with World() as world:
        body = add_slider(world)
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


def test_touches_distinguishes_the_links():
    with World() as world:
        body = add_slider(world)
        block = world.add(Box(size_m=(0.03, 0.03, 0.03)), "block")
        block.place((0.12, 0.0, 0.035))
        world.step(5)
        assert body.base.touches(block)
        assert not body.slider.touches(block)
        block.place((0.0, 0.0, 0.145))
        world.step(5)
        assert body.slider.touches(block)
        assert not body.base.touches(block)


def test_a_grasped_slider_is_not_held():
    with World() as world:
        robot = Kuka(world)
        rod = Solid(
            parts=(transform_mesh(rod_mesh(0.1, 0.02), (0.0, 0.0, 0.1)),), mass_kg=0.5, friction=1.0
        )
        base = Box(size_m=(0.05, 0.05, 0.02), mass_kg=0.0)
        body = world.add_articulated(base, rod, JOINT, "rod")
        body.place((0.45, 0.0, 0.01))
        down = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
        robot.teleport(robot.inverse_kinematics((0.45, 0.0, 0.11), down))
        robot.set_opening(0.3)
        robot.command_opening(0.0)
        world.step(30)
        points = pybullet.getContactPoints(robot.id, body.id, physicsClientId=world.client)
        fingers = {point[3] for point in points}
        assert all(fingers & links for links in robot.finger_links)
        assert robot.held_body() is None


def test_invalid_arguments_raise():
    with World() as world:
        body = add_slider(world)
        with pytest.raises(ValueError, match="joint"):
            body.slider.place((0.0, 0.0, 0.0))
        with pytest.raises(ValueError, match="outside"):
            body.place((0.0, 0.0, 0.0), travel_m=0.3)
        with pytest.raises(ValueError, match="mass"):
            add_slider(world, mass_kg=0.0)
        world.seal()
        with pytest.raises(SimulationError, match="sealed"):
            add_slider(world)
    with pytest.raises(ValueError, match="contain 0"):
        PrismaticJoint(limits_m=(0.1, 0.2), friction_n=1.0)
    with pytest.raises(ValueError, match="negative"):
        PrismaticJoint(limits_m=(0.0, 0.2), friction_n=-1.0)
