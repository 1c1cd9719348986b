"""Commands of the close-loop experts that carry bodies over others and descend to them."""

import math

import pytest

from ba_torchrl.sim.geometry import downward
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.manipulation.primitives import (
    CLOSED,
    OPEN,
    can_descend,
    grasp,
    nearest_equivalent_yaw,
)
from ba_torchrl.tasks.manipulation.transport import TRAVEL_CLEARANCE_M, pick_up, travel
from ba_torchrl.tasks.workspace import ActionLimits

LIMITS = ActionLimits(0.05, math.pi / 4)
SIDE = 0.05
BELOW_M = 0.04
TOP_M = SIDE + BELOW_M + TRAVEL_CLEARANCE_M
"""Height of the tool of which the held body passes over a cube."""


class Table:
    """Kuka and cubes on the floor."""

    def __init__(self, world):
        self.world = world
        self.robot = ROBOTS["kuka"](self.world)
        self.robot.set_opening(1.0)

    def cube(self, x, y, yaw=0.0):
        body = self.world.add(Box(size_m=(SIDE, SIDE, SIDE)), "cube")
        body.place((x, y, SIDE / 2), yaw)
        return body

    def tool(self, x, y, z, yaw=0.0):
        self.robot.teleport(self.robot.inverse_kinematics((x, y, z), downward(yaw)))
        (position, measured) = self.robot.tool_pose()
        assert position == pytest.approx((x, y, z), abs=1e-4)
        assert measured == pytest.approx(yaw, abs=1e-4)


@pytest.fixture
def table():
    with World() as world:
        yield Table(world)


def over(table, obstacle, z=TOP_M):
    x, y, _ = obstacle.position
    return travel(
        table.robot, (x, y, z), 0.0, CLOSED, below_m=BELOW_M, obstacles=[obstacle], ceiling_m=0.25
    )


@pytest.mark.parametrize("x", [0.4, 0.5, 0.55])
def test_a_low_tool_rises_before_it_moves_sideways(table, x):
    obstacle = table.cube(0.4, 0.0)
    table.tool(x, 0.12, 0.06)
    command = over(table, obstacle)
    assert (command.dx_m, command.dy_m) == (0.0, 0.0)
    assert command.dz_m == pytest.approx(TOP_M - 0.06, abs=2e-3)


@pytest.mark.parametrize("error", [-0.012, -0.006, 0.0, 0.02])
def test_small_errors_in_height_lead_to_no_other_ascent(table, error):
    obstacle = table.cube(0.4, 0.0)
    table.tool(0.4, 0.12, TOP_M + error)
    command = over(table, obstacle)
    assert command.dy_m == pytest.approx(-0.12, abs=1e-3)
    assert command.dz_m == pytest.approx(-error, abs=1e-3) or command.dz_m == 0.0


def test_without_an_obstacle_on_the_way_the_motion_is_straight(table):
    table.cube(0.4, 0.0)
    elsewhere = table.cube(0.55, 0.15)
    table.tool(0.4, 0.12, 0.06)
    command = travel(
        table.robot, (0.4, -0.1, 0.1), 0.0, CLOSED, below_m=BELOW_M, obstacles=[elsewhere]
    )
    assert command.dy_m == pytest.approx(-0.22, abs=1e-3)
    assert command.dz_m == pytest.approx(0.04, abs=1e-3)


@pytest.mark.parametrize("primitive", ["grasp", "pick_up"])
@pytest.mark.parametrize("turn", [-0.7, -0.2, 0.0, 0.5])
def test_the_gripper_turns_while_it_descends(table, primitive, turn):
    block = table.cube(0.45, 0.0)
    table.tool(0.453, -0.003, 0.09, turn)
    if primitive == "grasp":
        command = grasp(table.robot, block, LIMITS)
    else:
        yaws = [k * math.pi / 2 for k in (0, 1)]
        command = pick_up(table.robot, block, LIMITS, yaws_rad=yaws)
    assert command.dz_m == pytest.approx(SIDE / 2 - 0.09, abs=1e-3)
    assert command.dyaw_rad == pytest.approx(-turn, abs=1e-3)
    assert command[1:3] == pytest.approx((-0.003, 0.003), abs=1e-3)
    assert command.opening == OPEN  # the target is more than one action away


@pytest.mark.parametrize(
    ("offset", "z", "turn", "expected"),
    [
        (0.003, 0.04, 0.05, True),
        (0.006, 0.12, 0.6, True),
        (0.006, 0.04, 0.6, False),  # a finger is above the block
        (0.009, 0.12, 0.1, True),
        (0.021, 0.12, 0.0, False),  # too far from the centre
        (0.0, 0.12, 0.9, False),  # more than one action turns
    ],
)
def test_limits_of_the_descent(table, offset, z, turn, expected):
    block = table.cube(0.45, 0.0)
    table.tool(0.45 + offset, 0.0, z, turn)
    assert can_descend(table.robot, block, 0.0, LIMITS) == expected


def test_another_body_below_a_turned_finger_prevents_the_descent(table):
    block, other = table.cube(0.45, 0.0), table.cube(0.45 + 0.055, 0.055)
    for turn, expected in [(0.0, True), (0.7, False)]:
        table.tool(0.45, 0.0, 0.06, turn)
        assert can_descend(table.robot, block, 0.0, LIMITS)
        assert can_descend(table.robot, block, 0.0, LIMITS, [other]) == expected


@pytest.mark.parametrize(("yaw", "target"), [(0.9, 1.3), (-0.9, -1.3)])
def test_a_yaw_out_of_the_range_of_the_gripper_is_replaced_by_an_equivalent_one(yaw, target):
    quarter, limits = math.pi / 2, ActionLimits(0.05, 0.8, yaw_range_rad=(-1.0, 1.0))
    inside = target - math.copysign(quarter, target)
    assert nearest_equivalent_yaw(yaw, target, limits, quarter) == pytest.approx(inside)
    assert nearest_equivalent_yaw(yaw, target, LIMITS, quarter) == pytest.approx(target)
    assert nearest_equivalent_yaw(yaw, target, ActionLimits(0.05, 0.0), quarter) == yaw
