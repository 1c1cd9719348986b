"""Tilted tools and releases, for pieces on slopes."""

import math

import numpy as np
import pytest

from ba_torchrl.sim.geometry import (
    Pose,
    matrix_quaternion,
    quaternion_matrix,
    quaternion_product,
    surface_quaternion,
    tool_rotation,
)
from ba_torchrl.sim.robots.kuka import Kuka
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.manipulation.top_down_grasps import is_reachable
from ba_torchrl.tasks.structures.pieces import CUBE, CUBOID, ROOF
from ba_torchrl.tasks.structures.tilts import (
    in_resting_frame,
    release_pose,
    resting_frame,
    tilted_tools,
)

NORMAL = (math.sin(0.4), 0.0, math.cos(0.4))
SIDES = [  # rotations that turn a cube onto each of its sides
    (0.0, 0.0, 0.0, 1.0),
    (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)),
    (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)),
    (1.0, 0.0, 0.0, 0.0),
]


@pytest.fixture(scope="module")
def body():
    with World() as world:
        yield world.add(Box(size_m=(0.03, 0.12, 0.03)), "body")


def on_slope(body, yaw, side=SIDES[0]):
    frame = surface_quaternion(NORMAL, yaw)
    body.set_pose((0.45, 0.0, 0.1), quaternion_product(frame, side))
    return frame


def columns(quaternion):
    return np.array(quaternion_matrix(quaternion)).T


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("yaw", [0.3, 1.4, -2.0])
def test_the_resting_frame_of_a_cube_has_the_normal_of_the_slope(body, side, yaw):
    frame = columns(on_slope(body, yaw, side))
    resting = columns(resting_frame(CUBE, body))
    assert resting[2] == pytest.approx(NORMAL, abs=1e-6)
    turn = math.atan2(resting[0] @ frame[1], resting[0] @ frame[0])
    assert math.cos(4 * turn) == pytest.approx(1.0, abs=1e-6)  # up to quarter turns


@pytest.mark.parametrize("piece", [CUBE, CUBOID, ROOF], ids=lambda piece: piece.kind)
def test_the_resting_frame_of_a_level_piece_has_its_yaw(body, piece):
    body.place((0.45, 0.0, 0.1), 0.7)
    x_axis = columns(resting_frame(piece, body))[0]
    assert math.atan2(x_axis[1], x_axis[0]) == pytest.approx(piece.yaw_rad(body))


@pytest.mark.parametrize("yaw", [0.0, 0.6, -1.9])
def test_the_tools_close_across_the_piece_and_approach_between_normal_and_vertical(body, yaw):
    frame = columns(on_slope(body, yaw))
    tools = [columns(tool) for tool in tilted_tools(CUBOID, body)]
    assert len(tools) == 3
    for closing, _, _ in tools:
        assert abs(closing @ frame[0]) == pytest.approx(1.0, abs=1e-6)
    assert tools[0][2] == pytest.approx([-n for n in NORMAL], abs=1e-6)
    tilts = [math.acos(-approach[2]) for _, _, approach in tools]
    assert tilts == sorted(tilts, reverse=True)
    least = math.asin(abs(frame[0][2]))  # the approach is perpendicular to the closing axis
    assert tilts[-1] == pytest.approx(least, abs=1e-6)


@pytest.mark.parametrize("side", SIDES)
def test_a_release_lays_the_side_on_the_support_at_the_yaw(body, side):
    on_slope(body, 0.9, side)
    inner = in_resting_frame(CUBE, body)
    level = release_pose(CUBE, body, Pose((0.4, 0.1, 0.2)), 0.25)
    assert level.position == (0.4, 0.1, 0.2)
    assert columns(level.orientation) == pytest.approx(
        columns(quaternion_product(surface_quaternion((0.0, 0.0, 1.0), 0.25), inner)), abs=1e-9
    )
    assert np.abs(columns(level.orientation)[:, 2]).max() == pytest.approx(1.0, abs=1e-6)
    slope = release_pose(CUBE, body, Pose((0.4, 0.1, 0.2), surface_quaternion(NORMAL)), 0.25)
    along = columns(slope.orientation) @ np.array(NORMAL)
    assert np.abs(along).max() == pytest.approx(1.0, abs=1e-6)


def test_reach_counts_both_ways_of_holding_the_tool():
    with World() as world:
        robot = Kuka(world)
        near = Pose((0.45, 0.0, 0.1), _orientation(0.3, 0.2, 0.1))
        floor = frozenset((world.floor,))
        assert is_reachable(robot, floor, near)
        assert not is_reachable(robot, floor, near._replace(orientation=_orientation(0, 0, 1.6)))
        assert not is_reachable(robot, floor, near._replace(position=(1.2, 0.0, 0.1)))
        # in some poses only one of both ways is within reach: the hand is not symmetric
        single = 0
        for x in np.linspace(0.6, 0.8, 200).tolist():
            tool = Pose((x, -0.155, 0.033), _orientation(3.109, -0.155, -0.141))
            rotation = np.array(quaternion_matrix(tool.orientation))
            both = [
                robot.inverse_kinematics(tool.position, (rotation * (s, s, 1)).tolist())
                for s in (1, -1)
            ]
            single += (both[0] is None) != (both[1] is None)
            assert not (is_reachable(robot, floor, tool) and None in both)
        assert single > 0


def _orientation(rz, ry, rx):
    return matrix_quaternion(tool_rotation(rz, ry, rx))
