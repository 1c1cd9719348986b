"""Edge grasps and their clearances against values computed by hand."""

import math

import pytest

from ba_torchrl.sim.meshes import box_mesh, transform_mesh
from ba_torchrl.sim.robots.gripper import Gripper
from ba_torchrl.sim.shapes import Box, Solid
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.manipulation.clearance import path_clearance_m
from ba_torchrl.tasks.structures.piece_grasps import edge_grasps

CUBE = Box(size_m=(0.03, 0.03, 0.03))
AT = (0.45, 0.02, 0.015)
# 8 cm between open fingers that are 2 cm wide, 1.4 cm thick and reach 1 cm below the tool point
GRIPPER = Gripper(
    half_gap_m=0.04,
    half_width_m=0.01,
    closed_half_m=0.018,
    palm_height_m=0.05,
    tip_arc=((0.004, -0.01), (0.04, -0.01)),
    outline=((0.0, math.inf), (0.04, -0.01)),
    closed_outline=((0.0, -0.01),),
)


@pytest.fixture
def world():
    with World() as world:
        yield world


def test_the_near_finger_of_an_edge_grasp_has_a_clearance_of_two_millimetres(world):
    body = world.add(CUBE, "cube")
    body.place(AT)
    one, other = edge_grasps(GRIPPER, body, 0.0)
    assert (one.yaw_rad, other.yaw_rad) == pytest.approx((0.0, math.pi))
    for candidate in (one, other):
        assert candidate.across_m == pytest.approx(0.040 - 0.015 - 0.002, abs=1e-4)
        assert candidate.far_finger_range_m == pytest.approx(
            (0.015, 0.023 + 0.040 + 0.014), abs=1e-4
        )
        assert candidate.near_finger_range_m == pytest.approx(
            (-0.015 - 0.002 - 0.014, -0.015), abs=1e-4
        )


@pytest.mark.parametrize(
    ("yaw", "opening", "half_m"),
    [(math.pi / 4, 1.0, 0.015 * math.sqrt(2)), (math.pi / 2, 1.0, 0.015), (0.0, 0.5, 0.015)],
)
def test_the_shift_depends_on_opening_and_width_of_the_body(world, yaw, opening, half_m):
    body = world.add(CUBE, "cube")
    body.place(AT)
    for candidate in edge_grasps(GRIPPER, body, yaw, opening):
        assert candidate.across_m == pytest.approx(opening * 0.04 - half_m - 0.002, abs=1e-4)


def test_shifts_differ_for_a_body_that_is_not_centred_on_its_origin(world):
    off = transform_mesh(box_mesh((0.03, 0.03, 0.03)), (0.01, 0.0, 0.0), 0.0)
    body = world.add(Solid(parts=(off,)), "off")
    body.place(AT)
    shifts = [candidate.across_m for candidate in edge_grasps(GRIPPER, body, 0.0)]
    assert shifts == pytest.approx([0.04 - 0.005 - 0.002, 0.04 - 0.025 - 0.002], abs=1e-4)


def test_a_body_that_nearly_fills_the_gripper_has_no_edge_grasp(world):
    body = world.add(Box(size_m=(0.073, 0.03, 0.03)), "wide")
    body.place(AT)
    assert edge_grasps(GRIPPER, body, 0.0) == []


@pytest.mark.parametrize(
    ("offset", "yaw", "gap_m"),
    [
        # the way is 0.015 to 0.077 along and 0.01 to either side across
        ((0.100, 0.0), 0.0, 0.085 - 0.077),
        ((0.050, 0.0), 0.0, -0.025),  # across is the shortest way out
        ((0.085, 0.0), 0.0, 0.070 - 0.077),
        ((0.050, 0.030), 0.0, 0.015 - 0.010),
        ((-0.031, 0.0), 0.0, 0.015 + 0.016),  # beside the other finger
        ((0.0, 0.100), math.pi / 2, 0.085 - 0.077),
        ((-0.100, 0.0), math.pi, 0.085 - 0.077),
    ],
)
def test_clearance_on_the_path_of_a_finger(world, offset, yaw, gap_m):
    body, other = world.add(CUBE, "cube"), world.add(CUBE, "cube")
    body.place(AT)
    other.place((AT[0] + offset[0], AT[1] + offset[1], AT[2]))
    way_m = (0.015, 0.077)
    assert path_clearance_m(GRIPPER, body, yaw, (way_m,), [other]) == pytest.approx(gap_m, abs=1e-4)
    # what counts is the place of one beside that of the other
    other.place((AT[0] + offset[0] + 0.05, AT[1] + offset[1], AT[2]))
    at = (AT[0] + 0.05, *AT[1:])
    room = path_clearance_m(GRIPPER, body, yaw, (way_m,), [other], at)
    assert room == pytest.approx(gap_m, abs=1e-4)
