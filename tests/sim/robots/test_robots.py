"""Properties of every registered robot."""

import math

import numpy as np
import pybullet
import pytest

from ba_torchrl.sim.contacts import contacts, is_any_within
from ba_torchrl.sim.control.close_loop import CloseLoopController
from ba_torchrl.sim.geometry import downward, euler_matrix, rotation_array
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World
from tests.specs import slow_except_two_robots

CLOSE_LOOP = ((0.3, -0.15, 0.01), (0.6, 0.15, 0.25))
OPEN_LOOP = ((0.25, -0.2, 0.0), (0.65, 0.2, 0.4))
TILT = math.pi / 8
FLOOR_OVERLAP_M = {"kuka": 4e-3}
"""Penetration of the floor by closing fingertips that move on an arc, at the lowest tool height."""


class Scene:
    """A robot, and cubes that stay far away until a test places one under the gripper."""

    def __init__(self, name):
        self.name = name
        self.world = World()
        self.robot = ROBOTS[name](self.world)
        edges = {"cube": 0.05, "small": 0.03, "large": 0.1, "slippery": 0.05}
        self.cubes = {
            kind: self.world.add(
                Box(size_m=(edge,) * 3, friction=0.0 if kind == "slippery" else 1.0), kind
            )
            for kind, edge in edges.items()
        }
        for i, (kind, edge) in enumerate(edges.items()):
            self.cubes[kind].place((2.0 + i, 2.0, edge / 2))
        self.world.seal()

    def reset(self):
        self.world.restore_pristine()
        self.motion = CloseLoopController(self.robot)
        self.motion.reset(((0.45, 0.0, 0.2), 0.0))

    def put(self, kind="cube", yaw=0.0, xy=(0.45, 0.0)):
        """Place a cube on the floor and return it."""
        cube = self.cubes[kind]
        cube.place((*xy, cube.shape.size_m[2] / 2), yaw)
        self.world.settle()
        return cube

    def position_in_hand(self, body):
        to_tool = pybullet.invertTransform(*self.robot.tool_frame())
        return np.array(pybullet.multiplyTransforms(*to_tool, *body.pose)[0])


@pytest.fixture(scope="module", params=slow_except_two_robots())
def shared(request):
    scene = Scene(request.param)
    with scene.world:
        yield scene


@pytest.fixture
def scene(shared):
    shared.reset()
    return shared


@pytest.fixture
def robot(scene):
    return scene.robot


def random_rotation(rng, tilt, *yaws):
    about_x, about_y = -rng.uniform(-tilt, tilt), -rng.uniform(-tilt, tilt)
    turn = np.array(euler_matrix(0.0, 0.0, about_x)) @ euler_matrix(0.0, about_y, 0.0)
    return turn @ np.array(downward(rng.uniform(*yaws)))


def angle_between(a, b):
    return math.acos(np.clip((np.trace(a.T @ b) - 1) / 2, -1, 1))


@pytest.mark.parametrize(
    ("box", "tilt", "share"),
    [
        (CLOSE_LOOP, 0.0, 1.0),
        (CLOSE_LOOP, TILT, 0.98),
        (OPEN_LOOP, 0.0, 0.95),
        (OPEN_LOOP, TILT, 0.9),
    ],
    ids=["close loop", "close loop, tilted", "open loop", "open loop, tilted"],
)
def test_inverse_kinematics_in_the_workspace(robot, box, tilt, share):
    rng = np.random.default_rng(0)
    solved = 0
    for _ in range(400):
        position = rng.uniform(*box)
        rotation = random_rotation(rng, tilt, -math.pi, math.pi)
        joints = robot.inverse_kinematics(tuple(position.tolist()), rotation.tolist())
        if joints is None:
            continue
        solved += 1
        robot.teleport(joints)
        reached, quaternion = robot.tool_frame()
        np.testing.assert_allclose(reached, position, atol=1e-4)
        assert angle_between(rotation_array(quaternion), rotation) < 2e-3
    assert solved >= share * 400
    assert robot.inverse_kinematics((1.5, 0.0, 0.2), downward(0.0)) is None


def test_corners_of_the_close_loop_workspace_are_within_reach(robot):
    for corner in np.stack(np.meshgrid(*zip(*CLOSE_LOOP, strict=True)), -1).reshape(-1, 3):
        for yaw in np.linspace(-math.pi, math.pi, 9):
            joints = robot.inverse_kinematics(tuple(corner.tolist()), downward(yaw))
            robot.teleport(joints)
            position, measured = robot.tool_pose()
            np.testing.assert_allclose(position, corner, atol=1e-4)
            assert math.cos(measured - yaw) > 1 - 1e-6


def test_inverse_kinematics_is_continuous_along_a_path(robot):
    rng = np.random.default_rng(1)
    for _ in range(60):
        start, end = rng.uniform(*CLOSE_LOOP), rng.uniform(*CLOSE_LOOP)
        yaw, turn = rng.uniform(-math.pi, math.pi), rng.uniform(-1, 1)
        count = math.ceil(math.dist(start, end) / 0.003)
        joints = None
        for fraction in np.arange(count + 1) / count:
            before = joints
            joints = robot.inverse_kinematics(
                tuple((start + fraction * (end - start)).tolist()),
                downward(yaw + fraction * turn),
                before,
            )
            if before is not None:
                assert np.abs(np.subtract(joints, before)).max() < 0.1 + abs(turn) / count


def test_inverse_kinematics_is_continuous_along_a_tilted_approach(scene):
    rng = np.random.default_rng(2)
    jumps = 0
    for _ in range(200):
        goal = rng.uniform((0.3, -0.15, 0.02), (0.6, 0.15, 0.2))
        rotation = random_rotation(rng, TILT, 0, math.pi)
        joints, changes = None, [0.0]
        for height in np.linspace(0.1, 0.0, 41):  # along the approach direction, in steps of 2.5 mm
            before = joints
            point = tuple((goal - height * rotation[:, 2]).tolist())
            joints = scene.robot.inverse_kinematics(point, rotation.tolist(), before)
            if before is not None and joints is not None:
                changes.append(np.abs(np.subtract(joints, before)).max())
        jumps += max(changes) >= 1.0
    # joints 1 and 3 of the Panda where its upper arm is nearly vertical: 23 of 1600 approaches
    assert jumps <= (6 if scene.name == "panda" else 0)


def test_simulated_and_teleported_motions_reach_their_targets(scene):
    robot, world = scene.robot, scene.world
    rng = np.random.default_rng(3)
    for teleport in (True, False):
        motion = CloseLoopController(robot, teleport=teleport)
        motion.reset(((0.45, 0.0, 0.2), 0.0))
        yaw = 0.0
        for _ in range(20):
            target = rng.uniform((0.3, -0.15, 0.02), (0.6, 0.15, 0.25))
            yaw += rng.uniform(-math.pi / 4, math.pi / 4)
            before = world.steps
            motion.move_to(tuple(target.tolist()), yaw)
            position, measured = robot.tool_pose()
            assert math.dist(position, target) < 3e-3
            assert abs(math.remainder(measured - yaw, 2 * math.pi)) < math.radians(1)
            assert (world.steps - before == 1) is teleport


def gap_width(robot, height):
    """Return the distance between the fingers at a height above the tool point."""
    (x, y, z), yaw = robot.tool_pose()
    ends = [(x + s * math.cos(yaw), y + s * math.sin(yaw), z + height) for s in (-0.1, 0.1)]
    hits = pybullet.rayTestBatch([(x, y, z + height)] * 2, ends, physicsClientId=robot.client)
    assert all(hit[0] == robot.id for hit in hits)
    return 0.1 * sum(hit[2] for hit in hits)


def test_floor_clearance_and_opening_width(scene):
    robot, client = scene.robot, scene.world.client
    for opening in (1.0, 0.5, 0.0):
        robot.teleport(robot.inverse_kinematics((0.45, 0.0, 0.01), downward(0.3)))
        robot.set_opening(opening)
        scene.world.detect_collisions()
        overlap_m = FLOOR_OVERLAP_M.get(scene.name, 0.0)
        assert not is_any_within(contacts(client, robot.id), -overlap_m)
        assert robot.opening() == pytest.approx(opening, abs=1e-3)
        if opening == 1.0:
            assert 0.07 < gap_width(robot, 0.012) < 0.087
    # the closed fingertips are slightly below the tool point
    gap = min(
        point[8]
        for link in frozenset.union(*robot.finger_links)
        for point in pybullet.getClosestPoints(
            robot.id, scene.world.floor, 0.1, link, physicsClientId=client
        )
    )
    assert gap < 4e-3


@pytest.mark.parametrize(
    ("kind", "yaw_deg"), [("cube", 0), ("cube", 30), ("small", 77), ("cube", 90), ("small", -45)]
)
def test_grasp_holds_during_motion_and_releases(scene, kind, yaw_deg):
    robot, motion, yaw = scene.robot, scene.motion, math.radians(yaw_deg)
    block = scene.put(kind, yaw)
    edge = block.shape.size_m[2]
    motion.move_to((0.45, 0.0, 0.2), yaw)
    motion.move_to((0.45, 0.0, edge / 2), yaw)
    assert robot.held_body() is None
    motion.grip(0.0)
    assert robot.held_body() is block
    assert 0.2 < robot.opening() < 0.85
    start = scene.position_in_hand(block)
    square = [(0.05, 0.05, 0), (-0.05, 0.05, 0), (-0.05, -0.05, 0), (0.05, -0.05, 0)]
    for i, delta in enumerate([(0, 0, 0.05)] * 3 + square):
        if i >= 3:
            yaw += math.pi / 4
        position = robot.tool_pose()[0]
        motion.move_to(tuple(p + d for p, d in zip(position, delta, strict=True)), yaw)
        assert robot.held_body() is block
        assert np.abs(scene.position_in_hand(block) - start).max() < 3e-3
    assert block.position[2] > 0.15
    motion.grip(1.0)
    scene.world.settle()
    assert robot.held_body() is None
    assert robot.opening() > 0.97
    assert block.position[2] == pytest.approx(edge / 2, abs=1e-3)


def test_a_block_that_is_not_aligned_is_grasped_without_penetration(scene):
    block = scene.put(yaw=math.radians(28), xy=(0.448, 0.003))
    scene.motion.move_to((0.45, 0.0, 0.02), 0.0)
    scene.motion.grip(0.0)
    assert scene.robot.held_body() is block
    assert not is_any_within(contacts(scene.world.client, scene.robot.id, block.id), -5e-3)


def test_a_frictionless_block_is_not_held(scene):
    block = scene.put("slippery")
    scene.motion.move_to((0.45, 0.0, 0.025), 0.0)
    scene.motion.grip(0.0)
    scene.motion.move_to((0.45, 0.0, 0.2), 0.0)
    scene.world.settle()
    assert scene.robot.held_body() is None
    assert block.position[2] < 0.1


@pytest.mark.parametrize("opening", [0.0, 1.0])
def test_fingers_that_swing_after_a_body_has_slipped_out_reach_their_opening(scene, opening):
    """The motors close them at up to five times their speed, and past the closed position."""
    robot = scene.robot
    for steps in (3, 4, 5):
        scene.reset()
        block, motion = scene.put(), scene.motion
        motion.move_to((0.45, 0.0, 0.025), 0.0)
        motion.grip(0.0)
        assert robot.held_body() is block
        block.place((2.0, 2.0, 0.025))
        scene.world.step(steps)
        motion.grip(opening)
        scene.world.step()
        reached, rate = robot.finger_motion()
        assert reached == pytest.approx(opening, abs=0.02)
        assert abs(rate) < 1.0


def test_an_empty_closed_gripper_holds_nothing(scene):
    scene.put()
    scene.motion.move_to((0.45, 0.12, 0.02), 0.5)
    scene.motion.grip(0.0)
    assert scene.robot.opening() < 0.05
    assert scene.robot.held_body() is None


@pytest.mark.parametrize("opening", [0.0, 0.5])
def test_pressing_on_a_block_neither_grasps_nor_displaces_it(scene, opening):
    block = scene.put()
    scene.motion.grip(opening)
    for _ in range(3):
        scene.motion.move_to((0.45, 0.0, 0.01), 0.0)
        assert scene.robot.held_body() is None
    scene.world.settle()
    assert scene.robot.tool_pose()[0][2] > 0.045
    assert math.dist(block.position[:2], (0.45, 0.0)) < 5e-3
    # tolerance: the displacement of 3.3 mm in the step of the first contact and one press stride
    assert block.position[2] == pytest.approx(0.025, abs=3.9e-3)


def test_a_block_pushed_by_a_finger_is_not_held(scene):
    robot, motion = scene.robot, scene.motion
    block = scene.put(yaw=math.pi / 4, xy=(0.45, 0.06))
    motion.grip(0.5)
    motion.move_to((0.45, -0.02, 0.2), 0.0)
    motion.move_to((0.45, -0.02, 0.03), 0.0)
    for _ in range(3):
        motion.move_to((0.45, robot.tool_pose()[0][1] + 0.04, 0.03), 0.0)
        assert robot.held_body() is None
    assert block.position[1] > 0.1


@pytest.mark.parametrize("shared", ["kuka"], indirect=True)
def test_a_pushed_block_stays_at_the_finger(scene):
    """Too fast a motion or too sudden a stop leaves a gap of 5 mm or more when it is at rest."""
    block, motion = scene.put(), scene.motion
    motion.grip(0.5)
    motion.move_to((0.45, -0.06, 0.2), 0.0)
    motion.move_to((0.45, -0.06, 0.03), 0.0)
    for distance_m in (0.05, 0.05, 0.1):
        y = scene.robot.tool_pose()[0][1]
        motion.move_to((0.45, y + distance_m, 0.03), 0.0)
        scene.world.settle()
        gap = block.position[1] - scene.robot.tool_pose()[0][1]
        assert gap == pytest.approx(0.0325, abs=2e-3)


def test_unlimited_rotation_of_the_wrist(scene):
    for i in range(1, 41):
        yaw = i * math.pi / 4
        scene.motion.move_to((0.45, 0.0, 0.2), yaw)
        position, measured = scene.robot.tool_pose()
        assert position == pytest.approx((0.45, 0.0, 0.2), abs=1e-3)
        assert math.cos(measured - yaw) > 0.999
    assert abs(scene.robot.joints[-1]) < 2 * math.pi


def test_number_of_steps_of_a_motion_is_bounded(scene):
    scene.put()
    rng = np.random.default_rng(0)
    for _ in range(40):
        before = scene.world.steps
        scene.motion.move_to(tuple(rng.uniform(*CLOSE_LOOP).tolist()), rng.uniform(-3, 3))
        scene.motion.grip(rng.uniform(0, 1))
        assert scene.world.steps - before < 250


def test_home_configuration_is_outside_of_images(scene):
    robot, world = scene.robot, scene.world
    robot.teleport(robot.home_joints)
    robot.set_opening(1.0)
    world.detect_collisions()
    for link in (robot.hand_link, *robot.finger_links[0], *robot.finger_links[1]):
        low, high = pybullet.getAABB(robot.id, link, physicsClientId=world.client)
        is_beside = high[0] < 0.25 or low[0] > 0.65 or high[1] < -0.2 or low[1] > 0.2
        assert is_beside or low[2] > 0.4
    assert robot.tool_pose()[0][2] > 0.4
    # no joint moves by more than half a turn between home and a top-down pose
    joints = robot.inverse_kinematics((0.45, 0.0, 0.1), downward(0.0), robot.home_joints)
    assert np.abs(np.subtract(joints, robot.home_joints)).max() < math.pi


def test_the_arm_does_not_collide(scene):
    robot, block = scene.robot, scene.cubes["large"]
    robot.teleport(robot.inverse_kinematics((0.5, 0.0, 0.2), downward(0.0)))
    for link in robot.arm_joints[:-2]:
        state = pybullet.getLinkState(robot.id, link, physicsClientId=robot.client)
        block.place(state[0])
        scene.world.detect_collisions()
        points = pybullet.getContactPoints(robot.id, physicsClientId=robot.client)
        assert {point[3] for point in points} <= set(range(robot.hand_link, 20))
        assert not {point[3] for point in points} & set(robot.non_colliding_links)


@pytest.mark.parametrize(
    "quarter_turns", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 3))]
)
def test_a_rotated_hand_releases(scene, quarter_turns):
    block, motion = scene.put(), scene.motion
    motion.move_to((0.45, 0.0, 0.025), 0.0)
    motion.grip(0.0)
    motion.move_to((0.45, 0.0, 0.1), 0.0)
    for i in range(1, 2 * quarter_turns + 1):
        motion.move_to((0.45 + 0.03 * (i % 2), 0.0, 0.1), i * math.pi / 4)
    assert scene.robot.held_body() is block
    motion.grip(1.0)
    scene.world.step(60)
    assert scene.robot.opening() > 0.97
    assert block.position[2] == pytest.approx(0.025, abs=1e-3)


def trajectory(world, robot, blocks, motion):
    """Execute a fixed random sequence of actions and return all joints, openings and poses."""
    world.restore_pristine()
    motion.reset(((0.45, 0.0, 0.2), 0.0))
    for block, xy in zip(blocks, ((0.4, -0.06), (0.48, 0.05)), strict=True):
        block.place((*xy, 0.025), 0.3)
    world.settle()
    rng = np.random.default_rng(4)
    trace = []
    for _ in range(25):
        (x, y, z), yaw = robot.tool_pose()
        dx, dy, dz = rng.uniform(-0.05, 0.05, 3)
        target = np.clip((x + dx, y + dy, z + dz - 0.015), *CLOSE_LOOP)
        motion.move_to(tuple(target.tolist()), yaw + rng.uniform(-0.7, 0.7))
        motion.grip(float(rng.choice([0.0, 1.0])))
        trace += [*robot.measured_joints(), robot.opening()]
        for block in blocks:
            trace += [*block.position, *block.pose[1]]
    return trace


@pytest.mark.parametrize("name", slow_except_two_robots())
def test_random_actions_keep_blocks_in_place_and_repeat_bit_by_bit(name):
    traces = []
    with World() as first, World() as second:
        for world in (first, second):
            robot = ROBOTS[name](world)
            blocks = [world.add(Box(size_m=(0.05, 0.05, 0.05)), label) for label in "ab"]
            world.seal()
            motion = CloseLoopController(robot)
            traces += [trajectory(world, robot, blocks, motion) for _ in range(2)]
            assert all(math.dist(block.position[:2], (0.45, 0.0)) < 0.35 for block in blocks)
    assert np.isfinite(traces[0]).all()
    assert all(trace == traces[0] for trace in traces[1:])
