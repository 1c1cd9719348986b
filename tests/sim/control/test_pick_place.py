"""Picks and places of blocks, with the kuka unless stated otherwise."""

import math

import numpy as np
import pybullet
import pytest

from ba_torchrl.sim.bodies import vertical_extent
from ba_torchrl.sim.control.close_loop import quintic_time_scaling
from ba_torchrl.sim.control.pick_place import PEAK_ACCELERATION, PickPlace, PickPlaceLimits
from ba_torchrl.sim.geometry import tool_rotation
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import Physics, World
from ba_torchrl.tasks.terrain.flat import Flat
from ba_torchrl.tasks.workspace import Workspace
from tests.specs import slow_except_two_robots

B = 0.03
HOME_Z_M = 0.3
PHYSICS = Physics(time_step_s=1 / 240, solver_iterations=30, solver_residual=1e-5)


class Table:
    """A robot, blocks and static obstacles."""

    def __init__(
        self, count, *, static=(), teleport=True, robot="kuka", top_down=False, physics=PHYSICS
    ):
        self.world = World(physics)
        self.robot = ROBOTS[robot](self.world)
        self.blocks = [self.world.add(Box(size_m=(B, B, B)), f"cube {i}") for i in range(count)]
        self.obstacles = [
            self.world.add(Box(size_m=size, mass_kg=0.0), f"obstacle {i}")
            for i, (size, _) in enumerate(static)
        ]
        for body, (_, position) in zip(self.obstacles, static, strict=True):
            body.place(position)
        for i, block in enumerate(self.blocks):
            block.place((0.38 + 0.14 * (i // 2), -0.07 + 0.14 * (i % 2), B / 2))
        self.world.seal()
        floor = Flat(self.world, Workspace((0.3, 0.6), (-0.15, 0.15), (0.01, 0.25)))
        self.hand = PickPlace(self.robot, floor, teleport=teleport, top_down=top_down)
        self.hand.reset()
        self.world.settle()

    def pick(self, x, y, z, rz=0.0, ry=0.0, rx=0.0):
        body = self.hand.pick((x, y, z), tool_rotation(rz, ry, rx))
        self.world.settle()
        self.hand.update_grasp()
        return body

    def place(self, x, y, z, rz=0.0, ry=0.0, rx=0.0):
        self.hand.place((x, y, z), tool_rotation(rz, ry, rx))
        self.world.settle()
        self.hand.update_grasp()


@pytest.fixture
def table():
    tables = []

    def make(*args, **options):
        tables.append(Table(*args, **options))
        return tables[-1]

    yield make
    for table in tables:
        table.world.close()


@pytest.mark.parametrize("offset_m", [0.0, 3e-3])
def test_stacking_four_blocks_succeeds(table, offset_m):
    """A grasp that is off-centre by 3 mm results in a placement error of 3 mm."""
    t = table(4)
    pristine = t.world.snapshot()
    rng = np.random.default_rng(0)
    base, *others = t.blocks
    for _ in range(20):
        t.world.restore(pristine)
        t.hand.reset()
        for block in t.blocks:
            x, y, z = block.position
            block.place((x + rng.uniform(-0.01, 0.01), y, z), rng.uniform(-0.7, 0.7))
        t.world.settle()
        for level, block in enumerate(others, start=1):
            x, y, z = block.position
            yaw = block.yaw_rad
            side = rng.uniform(-math.pi, math.pi)
            held = t.pick(x + offset_m * math.cos(side), y + offset_m * math.sin(side), z, yaw)
            assert held is block
            assert block.is_hidden
            assert block.position[2] > HOME_Z_M
            t.place(*base.position[:2], (level + 0.5) * B, base.yaw_rad)
            assert not block.is_hidden
        x, y, _ = base.position
        for level, block in enumerate(others, start=1):
            assert block.position[2] == pytest.approx((level + 0.5) * B, abs=1.5e-3)
            assert math.dist(block.position[:2], (x, y)) < offset_m + 3e-3
            assert block.tilt_rad < 0.05
        assert t.world.is_still()


@pytest.mark.parametrize("top_down", [False, True])
def test_approach_is_along_the_tool_axis_or_top_down(table, top_down):
    t = table(1, top_down=top_down)
    block, positions = t.blocks[0], []
    solve = t.robot.inverse_kinematics

    def record(position, *others):
        positions.append(position)
        return solve(position, *others)

    t.robot.inverse_kinematics = record
    x, y, z = block.position
    assert t.pick(x, y, z, 0.0, 0.0, 0.35) is block
    path = np.array([point for point in positions if math.dist(point[:2], (x, y)) < 0.1])
    lateral = np.linalg.norm(path[:, :2] - (x, y), axis=1)
    assert np.ptp(path[:, 2]) > 0.05
    if top_down:
        assert lateral.max() < 2e-3
    else:  # along the z axis of the tool
        np.testing.assert_allclose(lateral, math.tan(0.35) * (path[:, 2] - z), atol=4e-3)


def test_a_body_stays_held_if_the_target_is_out_of_reach(table):
    t = table(1)
    block = t.blocks[0]
    assert t.pick(*block.position) is block
    assert not t.hand.is_out_of_reach
    t.place(1.4, 0.0, 0.1)
    assert t.hand.is_out_of_reach
    assert t.hand.held is block
    assert block.position[2] > HOME_Z_M
    assert t.pick(1.4, 0.0, 0.1) is block  # the body is still held after a pick out of reach


def test_a_pick_at_an_empty_position_changes_nothing(table):
    t = table(2)
    before = [block.pose for block in t.blocks]
    assert t.pick(0.5, 0.15, B / 2) is None
    assert t.hand.held is None
    for block, pose in zip(t.blocks, before, strict=True):
        np.testing.assert_allclose(block.position, pose[0], atol=1e-4)
    assert t.robot.opening() == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(t.robot.joints, t.robot.home_joints)


@pytest.mark.parametrize("robot", slow_except_two_robots())
@pytest.mark.parametrize("teleport", [True, False])
def test_a_pick_near_the_floor_succeeds(table, robot, teleport):
    """Fingers that move down as they close stay clear of the floor."""
    t = table(1, robot=robot, teleport=teleport)
    pristine = t.world.snapshot()
    block = t.blocks[0]
    for z in (0.0, 0.005, 0.01):
        t.world.restore(pristine)
        t.hand.reset()
        assert t.pick(*block.position[:2], z) is block, z
        assert block.position[2] > HOME_Z_M


@pytest.mark.parametrize("robot", slow_except_two_robots())
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.4, 0.0, 0.3), (0.4, -0.3, 0.2)])
def test_lowest_tool_is_tight_for_closing_fingers(table, robot, turn):
    """At the lowest height of the tool, the clearance of the closing fingers is 1 mm."""
    t = table(1, robot=robot)
    rotation = tool_rotation(*turn)
    lowest = t.robot.gripper.lowest_tool_m(rotation)
    if turn == (0.0, 0.0, 0.0):
        assert lowest == t.robot.gripper.lowest_tool_m()

    def gap_m(opening):
        t.robot.teleport(t.robot.inverse_kinematics((0.5, 0.1, 0.3), rotation))
        t.robot.set_opening(opening)
        points = [
            point
            for link in frozenset.union(*t.robot.finger_links)
            for point in pybullet.getClosestPoints(
                t.robot.id, t.world.floor, 0.5, linkIndexA=link, physicsClientId=t.world.client
            )
        ]
        return min(point[8] for point in points) - (0.3 - lowest)

    gap = min(gap_m(opening) for opening in np.linspace(0.0, 1.0, 21))
    if turn == (0.0, 0.0, 0.0):
        assert gap == pytest.approx(1e-3, abs=5e-4)
    else:  # only approximate: thickness and chamfers of the fingers are neglected
        assert -0.01 < gap < 3e-3


def test_only_picks_below_the_lowest_tool_are_raised(table):
    t = table(1)
    lowest = t.robot.gripper.lowest_tool_m()
    reached = []
    close = t.hand._close_fingers
    t.hand._close_fingers = lambda: (reached.append(t.robot.tool_frame().position[2]), close())
    for z in (lowest - 5e-3, lowest, lowest + 5e-3):
        t.pick(0.5, 0.15, z)
    assert reached == pytest.approx([lowest, lowest, lowest + 5e-3], abs=1e-5)


def test_an_obstacle_stops_the_approach(table):
    """The target is inside a static block."""
    t = table(1, static=[((0.2, 0.2, 0.1), (0.5, 0.0, 0.05))])
    lowest = []
    step = t.world.step

    def recording_step(count=1):
        step(count)
        lowest.append(t.robot.tool_frame().position[2])

    t.world.step = recording_step
    assert t.pick(0.5, 0.0, 0.02) is None
    # the fingertips, a centimetre below the tool point, stop on top of the block
    assert min(lowest) == pytest.approx(0.1 + 0.011, abs=0.01)
    np.testing.assert_allclose(t.obstacles[0].position, (0.5, 0.0, 0.05), atol=1e-9)


def test_placing_on_an_occupied_position_does_not_penetrate(table):
    t = table(2)
    block, below = t.blocks
    assert t.pick(*block.position) is block
    x, y, _ = below.position
    t.place(x, y, B / 2)  # the position of the other block
    assert t.hand.held is None
    assert below.position[2] == pytest.approx(B / 2, abs=1e-3)
    assert block.position[2] > B / 2 - 1e-3
    assert min(block.position[2], below.position[2]) > B / 2 - 1e-3


def test_pick_and_place_without_teleport(table):
    t = table(2, teleport=False)
    block, below = t.blocks
    steps = t.world.steps
    assert t.pick(*block.position) is block
    assert t.world.steps - steps > 100
    t.place(*below.position[:2], 1.5 * B, math.pi / 2)
    assert t.hand.held is None
    assert block.position[2] == pytest.approx(1.5 * B, abs=1e-3)
    assert math.dist(block.position[:2], below.position[:2]) < 3e-3


def test_update_grasp_releases_a_lost_body(table):
    t = table(1)
    block = t.blocks[0]
    assert t.pick(*block.position) is block
    block.place((0.5, 0.1, B / 2))
    t.hand.update_grasp()
    assert t.hand.held is None
    assert not block.is_hidden


def test_peak_acceleration_of_quintic_time_scaling():
    u = np.linspace(0.0, 1.0, 20001)
    values = np.array([quintic_time_scaling(x) for x in u.tolist()])
    acceleration = np.diff(values, n=2) / (u[1] - u[0]) ** 2
    assert values[0] == 0.0
    assert values[-1] == 1.0
    assert np.abs(acceleration).max() == pytest.approx(PEAK_ACCELERATION, rel=1e-3)
    assert PickPlaceLimits().held_acceleration_m_s2 < PickPlaceLimits().acceleration_m_s2


@pytest.mark.parametrize("rise_m", [0.0, 1e-4, 3e-4])
def test_a_body_released_just_above_a_box_does_not_hit_it(table, rise_m):
    top_m = 0.02
    table = table(1, static=[((0.1, 0.1, top_m), (0.5, 0.15, top_m / 2))], physics=Physics())
    cube = table.blocks[0]
    x, y, z = cube.position
    table.pick(x, y, z)
    x, y, z = table.robot.tool_frame().position
    low_m = vertical_extent(cube)[0]
    table.hand.place((0.5, 0.15, z - low_m + top_m + rise_m), tool_rotation(0.0, 0.0, 0.0))
    assert vertical_extent(cube)[0] > top_m - 1e-3
