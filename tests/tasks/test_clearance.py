"""Clearances of a gripper against values computed by hand."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ba_torchrl.sim.bodies import world_vertices
from ba_torchrl.sim.geometry import (
    PlanarFrame,
    Pose,
    matrix_quaternion,
    rotation_array,
    tool_rotation,
)
from ba_torchrl.sim.robots.gripper import Gripper
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.manipulation.clearance import (
    INNER_MARGIN_M,
    OUTER_MARGIN_M,
    SIDE_MARGIN_M,
    finger_ranges_m,
    grasp_clearance_m,
    passing_height_m,
    tips_below_tool_m,
)
from ba_torchrl.tasks.manipulation.footprints import Rectangle
from ba_torchrl.tasks.manipulation.hand_clearance import (
    finger_rectangles,
    hand_clearance_m,
    hand_rectangle,
    knuckles_m,
    outline_clearances_m,
    tool_clearances_m,
)

EDGE_M = 0.03
GRIPPER = Gripper(
    half_gap_m=0.04,
    half_width_m=0.01,
    closed_half_m=0.018,
    palm_height_m=0.05,
    tip_arc=((0.004, -0.01), (0.04, -0.006)),
    outline=((0.0, math.inf), (0.04, -0.01), (0.06, 0.015), (0.07, 0.045)),
    closed_outline=((0.0, -0.01), (0.02, 0.01), (0.035, 0.03)),
)
WIDE = replace(GRIPPER, half_width_m=0.015)


@pytest.fixture
def cubes():
    with World() as world:
        shape = Box(size_m=(EDGE_M,) * 3)
        yield world.add(shape, "grasped"), world.add(shape, "other")


def test_extents_of_the_gripper_follow_from_its_outline():
    assert GRIPPER.finger_depth_m == pytest.approx(0.014)
    assert GRIPPER.finger_reach_m == 0.06
    tips_only = replace(GRIPPER, outline=((0.0, math.inf), (0.04, -0.01)))
    assert tips_only.finger_reach_m == pytest.approx(0.054)
    reach_m = [GRIPPER.finger_reach_below_m(z) for z in (-0.003, 0.003, 0.02, 0.05)]
    assert reach_m == pytest.approx([0.054, 0.054, 0.06, 0.07])
    assert GRIPPER.finger_reach_below_m(0.02, 0.5) == pytest.approx(0.04)
    assert knuckles_m(GRIPPER) == (0.07, 0.045)
    assert knuckles_m(tips_only) == (0.0, math.inf)
    assert GRIPPER.lowest_tip_m == -0.01
    assert [GRIPPER.closed_reach_m(z) for z in (-0.02, 0.0, 0.02, 0.1)] == [0, 0, 0.02, 0.035]


@pytest.mark.parametrize("opening", [0.5, 1.0])
def test_finger_ranges_include_both_margins(opening):
    left, right = finger_ranges_m(GRIPPER, opening)
    inner = opening * (0.04 - INNER_MARGIN_M)
    assert right == pytest.approx((inner, 0.06 - (1 - opening) * 0.04 + OUTER_MARGIN_M))
    assert left == (-right[1], -right[0])


@pytest.mark.parametrize("gripper", [GRIPPER, WIDE])
@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_wider_fingers_have_less_clearance_beside_a_neighbour(cubes, gripper, yaw):
    body, other = cubes
    frame = PlanarFrame(0.45, 0.02, yaw)
    body.place((0.45, 0.02, EDGE_M / 2), yaw)
    # along the closing direction at a finger, across it at its flank
    other.place((*frame.to_world(0.05, 0.035), EDGE_M / 2), yaw)
    gap = grasp_clearance_m(gripper, body, yaw, [other])
    assert gap == pytest.approx(0.035 - EDGE_M / 2 - gripper.half_width_m, abs=1e-4)


def test_bodies_below_the_fingertips_are_no_obstacles(cubes):
    body, other = cubes
    body.place((0.45, 0.0, 0.1))
    other.place((0.5, 0.0, EDGE_M / 2))
    assert grasp_clearance_m(GRIPPER, body, 0.0, [other]) == math.inf
    low = (0.45, 0.0, EDGE_M + 0.01 - 1e-3)  # the tips end 1 cm below the tool
    assert grasp_clearance_m(GRIPPER, body, 0.0, [other], at=low) < 0


def test_only_bodies_higher_than_the_palm_are_obstacles_of_the_hand(cubes):
    _, other = cubes
    robot = SimpleNamespace(gripper=GRIPPER, hand_half_extents_m=(0.07, 0.03))
    tool = PlanarFrame(0.45, 0.0, math.pi / 2)
    other.place((0.45, 0.1, EDGE_M / 2))
    above = EDGE_M - GRIPPER.palm_height_m
    assert hand_clearance_m(robot, tool, above + 1e-3, [other]) == math.inf
    gap = hand_clearance_m(robot, tool, above - 1e-3, [other])
    assert gap == pytest.approx(0.1 - EDGE_M / 2 - 0.07, abs=1e-4)
    assert hand_rectangle(robot, tool) == Rectangle(0.45, 0.0, math.pi / 2, 0.07, 0.03)


def test_clearances_of_tilted_tools_are_gaps_in_the_frame_of_each_tool(cubes):
    """Compared with the gaps between projections of vertices onto 16 lines, one at a time."""
    _, other = cubes
    robot = SimpleNamespace(gripper=GRIPPER, hand_half_extents_m=(0.05, 0.03))
    inner, outer, half_width = 0.04 - INNER_MARGIN_M, 0.06 - INNER_MARGIN_M, 0.01 + SIDE_MARGIN_M
    parts = [  # extents along the closing axis and across it, and height above the tool point
        ((inner, outer), (-half_width, half_width), -0.01),
        ((-outer, -inner), (-half_width, half_width), -0.01),
        ((-0.05, 0.05), (-0.03, 0.03), 0.05),
        ((-0.07, 0.07), (-half_width, half_width), 0.045),
    ]
    rng = np.random.default_rng(1)
    tools = [
        Pose((0.45, 0.0, 0.02), matrix_quaternion(tool_rotation(*angles)))
        for angles in rng.uniform((-3.0, -0.4, -0.4), (3.0, 0.4, 0.4), (6, 3))
    ]
    found = []
    for _ in range(40):
        other.set_pose(
            tuple(rng.uniform((0.38, -0.07, 0.0), (0.52, 0.07, 0.08))),
            matrix_quaternion(tool_rotation(*rng.uniform(-1.0, 1.0, 3))),
        )
        gaps = tool_clearances_m(robot, tools, [other])
        for tool, gap in zip(tools, gaps, strict=True):
            x_axis, y_axis, z_axis = rotation_array(tool.orientation).T
            points = [
                (offset @ x_axis, -(offset @ y_axis), -(offset @ z_axis))
                for offset in world_vertices(other) - tool.position
            ]
            least = math.inf
            for (x0, x1), (y0, y1), height in parts:
                if max(z for _, _, z in points) <= height:
                    continue
                widest = -math.inf
                for i in range(16):
                    cos, sin = math.cos(i * math.pi / 16), math.sin(i * math.pi / 16)
                    ours = [cos * x + sin * y for x in (x0, x1) for y in (y0, y1)]
                    theirs = [cos * x + sin * y for x, y, _ in points]
                    widest = max(widest, min(theirs) - max(ours), min(ours) - max(theirs))
                least = min(least, widest)
            found.append(least)
            assert gap == (least if least == math.inf else pytest.approx(least, abs=1e-9))
    assert min(found) < 0 < max(found)


def test_footprints_of_the_fingers_and_their_clearance_from_an_outline():
    tool = PlanarFrame(0.4, 0.1, math.pi / 2)
    left, right = finger_rectangles(GRIPPER, tool, 0.03)
    assert left[:2] == pytest.approx((0.4, 0.1 - 0.04))
    assert right == pytest.approx((0.4, 0.1 + 0.04, math.pi / 2, 0.01, 0.01 + SIDE_MARGIN_M))
    wall = Rectangle(0.4, 0.2, 0.0, 0.1, 0.01)
    lower = tool._replace(y=0.05)
    gaps = outline_clearances_m(GRIPPER, [tool, lower], 0.03, [wall])
    assert gaps == pytest.approx([0.2 - 0.01 - (0.1 + 0.05), 0.2 - 0.01 - (0.05 + 0.05)])
    assert list(outline_clearances_m(GRIPPER, [tool, lower], 0.03, [])) == [math.inf, math.inf]


def test_heights_follow_from_the_depth_of_the_fingertips():
    assert passing_height_m(GRIPPER) == 0.03
    assert passing_height_m(replace(GRIPPER, tip_arc=((0.0, -0.04),))) == pytest.approx(0.052)
    robot = SimpleNamespace(gripper=GRIPPER, opening=lambda: 1.0)
    assert tips_below_tool_m(robot) == pytest.approx(0.006)
