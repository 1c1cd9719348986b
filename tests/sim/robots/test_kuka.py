import math

import numpy as np
import pybullet
import pytest

from ba_torchrl.sim.control.close_loop import CloseLoopController
from ba_torchrl.sim.geometry import downward
from ba_torchrl.sim.robots.kuka import Kuka
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World


@pytest.fixture
def world():
    with World() as world:
        yield world


def rotation_of(quaternion):
    return np.array(pybullet.getMatrixFromQuaternion(quaternion)).reshape(3, 3)


def random_tilt(rng, limit):
    axis = rng.normal(size=3)
    axis *= rng.uniform(0, limit) / np.linalg.norm(axis)
    angle = np.linalg.norm(axis)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]]) / max(
        angle, 1e-12
    )
    return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k


def test_inverse_kinematics_agrees_with_forward_kinematics(world):
    robot = Kuka(world)
    rng = np.random.default_rng(0)
    solved = 0
    for _ in range(500):
        position = rng.uniform([0.25, -0.2, 0.01], [0.65, 0.2, 0.4])
        rotation = random_tilt(rng, 0.5) @ np.array(downward(rng.uniform(-math.pi, math.pi)))
        joints = robot.inverse_kinematics(tuple(position), rotation.tolist())
        if joints is None:
            continue
        solved += 1
        robot.teleport(joints)
        reached, quaternion = robot.tool_frame()
        np.testing.assert_allclose(reached, position, atol=2e-5)
        np.testing.assert_allclose(rotation_of(quaternion), rotation, atol=1e-4)
    assert solved > 400


def test_inverse_kinematics_out_of_reach_returns_none(world):
    assert Kuka(world).inverse_kinematics((1.5, 0.0, 0.2), downward(0.0)) is None


def test_tool_pose_returns_position_and_yaw(world):
    robot = Kuka(world)
    for yaw in np.linspace(-3.1, 3.1, 13):
        robot.teleport(robot.inverse_kinematics((0.45, 0.05, 0.2), downward(yaw)))
        position, measured = robot.tool_pose()
        np.testing.assert_allclose(position, (0.45, 0.05, 0.2), atol=2e-5)
        assert measured == pytest.approx(yaw, abs=1e-4)


def grasp_scene(world, friction=1.0):
    robot = Kuka(world)
    block = world.add(Box(size_m=(0.05, 0.05, 0.05), friction=friction), "block")
    world.seal()
    motion = CloseLoopController(robot)
    motion.reset(((0.45, 0.0, 0.2), 0.0))
    block.place((0.45, 0.0, 0.025), 0.0)
    world.settle()
    return robot, block, motion


def test_grasp_holds_by_friction_and_releases(world):
    robot, block, motion = grasp_scene(world)
    assert robot.held_body() is None
    motion.move_to((0.45, 0.0, 0.025), 0.0)
    assert robot.held_body() is None
    motion.grip(0.0)
    assert robot.held_body() is block
    assert 0.3 < robot.opening() < 0.8
    rng = np.random.default_rng(0)
    yaw = 0.0
    for dz in [0.05] * 3 + [0.0] * 20:
        position, _ = robot.tool_pose()
        delta = (*rng.uniform(-0.05, 0.05, 2), dz)
        yaw += rng.uniform(-math.pi / 4, math.pi / 4)
        target = np.clip(np.add(position, delta), (0.3, -0.15, 0.01), (0.6, 0.15, 0.25))
        motion.move_to(tuple(target.tolist()), yaw)
        assert robot.held_body() is block
        np.testing.assert_allclose(block.position, robot.tool_pose()[0], atol=5e-3)
    assert (
        pybullet.getNumConstraints(physicsClientId=world.client) == 1
    )  # the gear between the fingers
    motion.grip(1.0)
    world.settle()
    assert robot.held_body() is None
    assert block.position[2] == pytest.approx(0.025, abs=1e-3)


def test_a_frictionless_block_is_not_held(world):
    robot, block, motion = grasp_scene(world, friction=0.0)
    motion.move_to((0.45, 0.0, 0.025), 0.0)
    motion.grip(0.0)
    motion.move_to((0.45, 0.0, 0.2), 0.0)
    world.settle()
    assert block.position[2] < 0.1
    assert robot.held_body() is None


def test_a_block_pushed_at_its_corner_is_not_held(world):
    robot, block, motion = grasp_scene(world)
    block.place((0.45, 0.06, 0.025), math.pi / 4)
    motion.grip(0.5)
    motion.move_to((0.45, 0.0, 0.03), 0.0)
    for _ in range(2):
        motion.move_to((0.45, robot.tool_pose()[0][1] + 0.04, 0.03), 0.0)
        assert robot.held_body() is None
    assert block.position[1] > 0.08


def test_a_pushed_block_stays_at_the_finger(world):
    robot, block, motion = grasp_scene(world)
    motion.grip(0.5)
    motion.move_to((0.45, -0.06, 0.2), 0.0)
    motion.move_to((0.45, -0.06, 0.03), 0.0)
    for _ in range(3):
        y = robot.tool_pose()[0][1]
        motion.move_to((0.45, y + 0.05, 0.03), 0.0)
        gap = block.position[1] - robot.tool_pose()[0][1]
        assert gap == pytest.approx(0.025 + 0.0095, abs=6e-3)


def test_downward_motion_stops_at_the_force_limit(world):
    robot, block, motion = grasp_scene(world)
    motion.grip(0.0)
    for _ in range(3):
        motion.move_to((0.45, 0.0, 0.01), 0.0)
    world.settle()
    assert robot.tool_pose()[0][2] > 0.05
    assert math.hypot(block.position[0] - 0.45, block.position[1]) < 5e-3
    # tolerance: the displacement of 3.3 mm in the step in which the hand touches the block
    assert block.position[2] == pytest.approx(0.025, abs=3e-3)


def test_unlimited_rotation_of_the_wrist(world):
    robot, _, motion = grasp_scene(world)
    yaw = 0.0
    for _ in range(60):
        yaw += math.pi / 4
        motion.move_to((0.45, 0.0, 0.2), yaw)
        (x, y, z), measured = robot.tool_pose()
        assert (x, y, z) == pytest.approx((0.45, 0.0, 0.2), abs=1e-3)
        assert math.cos(measured - yaw) > 0.999
    assert abs(robot.joints[-1]) < 2 * math.pi


def test_teleported_and_simulated_motion_reach_the_same_pose():
    ends = []
    for teleport in (True, False):
        with World() as world:
            robot = Kuka(world)
            world.add(Box(size_m=(0.05, 0.05, 0.05)), "block").place((0.35, 0.1, 0.025))
            world.seal()
            motion = CloseLoopController(robot, teleport=teleport)
            motion.reset(((0.45, 0.0, 0.2), 0.0))
            before = world.steps
            motion.move_to((0.5, 0.05, 0.15), 0.5)
            ends.append((robot.tool_pose(), world.steps - before))
    (fast, fast_steps), (slow, slow_steps) = ends
    np.testing.assert_allclose(fast[0], slow[0], atol=1e-3)
    assert fast[1] == pytest.approx(slow[1], abs=5e-3)
    assert fast_steps == 1
    assert slow_steps > 10


def test_number_of_steps_of_a_motion_is_bounded(world):
    _, _, motion = grasp_scene(world)
    rng = np.random.default_rng(0)
    for _ in range(100):
        before = world.steps
        motion.move_to(
            tuple(rng.uniform([0.3, -0.15, 0.01], [0.6, 0.15, 0.25])), rng.uniform(-3, 3)
        )
        motion.grip(rng.uniform(0, 1))
        assert world.steps - before < 250


@pytest.mark.parametrize("yaw_deg", [0, 15, 28, 40])
def test_a_rotated_block_is_grasped_without_penetration(world, yaw_deg):
    robot, block, motion = grasp_scene(world)
    block.place((0.448, 0.003, 0.025), math.radians(yaw_deg))
    motion.move_to((0.45, 0.0, 0.02), 0.0)
    motion.grip(0.0)
    assert robot.held_body() is block
    points = pybullet.getContactPoints(robot.id, block.id, physicsClientId=world.client)
    assert min(point[8] for point in points) > -5e-3
    for _ in range(3):
        x, y, z = robot.tool_pose()[0]
        motion.move_to((x, y, z + 0.05), 0.0)
        assert robot.held_body() is block
    assert block.position[2] > 0.15
