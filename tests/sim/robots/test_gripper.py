"""The measured outlines of the grippers, compared with contacts and with the models."""

import math

import numpy as np
import pybullet
import pytest

from ba_torchrl.sim.geometry import downward, tool_rotation
from ba_torchrl.sim.robots.base import ROBOTS, measured_gripper
from ba_torchrl.sim.robots.gripper import GRASP_HEIGHT_M, Gripper
from ba_torchrl.sim.world import World
from tests.specs import slow_except_two_robots

POSITION = (0.45, 0.0, 0.25)
RAY_M = 3e-3
"""Largest lateral error of the measurement: the ray spacing plus the collision margins."""


@pytest.fixture(params=slow_except_two_robots())
def name(request):
    return request.param


class Probe:
    """A gripper that points down and is tested for contact with boxes."""

    def __init__(self, world, name, opening):
        self.world = world
        self.robot = ROBOTS[name](world)
        self.robot.teleport(self.robot.inverse_kinematics(POSITION, downward(0.0)))
        self.robot.set_opening(opening)

    def touches(self, size_m, x_m, top_m):
        """Whether the gripper touches a box.

        Args:
            size_m: edge lengths of the box.
            x_m: of the box relative to the tool point.
            top_m: height of the top of the box above the tool point.
        """
        box = pybullet.createMultiBody(
            0,
            pybullet.createCollisionShape(
                pybullet.GEOM_BOX,
                halfExtents=[edge / 2 for edge in size_m],
                physicsClientId=self.world.client,
            ),
            basePosition=(POSITION[0] + x_m, POSITION[1], POSITION[2] + top_m - size_m[2] / 2),
            physicsClientId=self.world.client,
        )
        points = pybullet.getClosestPoints(
            self.robot.id, box, 0.1, physicsClientId=self.world.client
        )
        nearest = min((point[8] for point in points), default=math.inf)
        pybullet.removeBody(box, physicsClientId=self.world.client)
        return nearest <= 0


def test_gripper_is_measured_once_per_robot_class(name):
    with World() as world:
        robot = ROBOTS[name](world)
        assert robot.gripper is measured_gripper(ROBOTS[name])
        assert robot.gripper is robot.gripper
    assert isinstance(robot.gripper, Gripper)


def test_half_gap_of_the_open_fingers(name):
    gripper = measured_gripper(ROBOTS[name])
    low = gripper.tip_height_m(gripper.half_gap_m)
    with World() as world:
        probe = Probe(world, name, 1.0)
        for margin, touches in ((-RAY_M, False), (RAY_M, True)):
            size = (2 * (gripper.half_gap_m + margin), 0.01, 0.01)
            assert probe.touches(size, 0.0, low + 0.01) is touches


@pytest.mark.parametrize("opening", [0.0, 1.0])
def test_outline_is_the_lower_boundary_of_the_hand(name, opening):
    gripper = measured_gripper(ROBOTS[name])
    outline = gripper.outline if opening else gripper.closed_outline
    spacing = outline[1][0]
    band = 2 * gripper.half_width_m
    with World() as world:
        probe = Probe(world, name, opening)
        for u, height in outline:
            if not math.isfinite(height):
                continue
            for side in (-1, 1):
                # as wide as the spacing of the outline, reduced by the lateral error
                assert not probe.touches((spacing - RAY_M, band, 0.02), side * u, height - 1e-3)
                assert probe.touches((spacing + 2 * RAY_M, 0.04, 0.02), side * u, height + 2e-3)
        reach = outline[-1][0]
        assert not probe.touches((0.01, band, 0.05), reach + 0.01, 0.05)


@pytest.mark.parametrize("opening", [0.0, 0.5, 1.0])
def test_tip_arc_is_the_height_of_the_fingertips(name, opening):
    gripper = measured_gripper(ROBOTS[name])
    gap, height = gripper.tip_arc[round(opening * (len(gripper.tip_arc) - 1))]
    with World() as world:
        probe = Probe(world, name, opening)
        assert not probe.touches((0.2, 0.1, 0.02), 0.0, height - 1e-3)
        assert probe.touches((0.2, 0.1, 0.02), 0.0, height + 1e-3)
        if gap > 2 * RAY_M:
            assert not probe.touches((2 * (gap - RAY_M), 0.005, 0.01), 0.0, height + 0.01)


def test_palm_height_at_every_opening(name):
    gripper = measured_gripper(ROBOTS[name])
    with World() as world:
        probe = Probe(world, name, 1.0)
        for opening in (0.4, 0.7, 1.0):
            probe.robot.set_opening(opening)
            gap = next(
                gap for gap, _ in gripper.tip_arc if gap > 0.9 * opening * gripper.half_gap_m
            )
            width = 2 * (min(gap, opening * gripper.half_gap_m) - 3 * RAY_M)
            assert not probe.touches((width, 0.005, 0.02), 0.0, gripper.palm_height_m - 1e-3)


def test_hand_half_extents_agree_with_the_outline(name):
    reach = measured_gripper(ROBOTS[name]).outline[-1][0]
    assert ROBOTS[name].hand_half_extents_m[0] == pytest.approx(reach, abs=6e-3)


def test_parallel_jaw_agrees_with_its_model():
    gripper = measured_gripper(ROBOTS["ur5"])
    assert gripper.half_gap_m == pytest.approx(0.04, abs=RAY_M)
    assert gripper.half_width_m == pytest.approx(0.019 / 2, abs=RAY_M)
    assert gripper.closed_half_m == pytest.approx(0.016, abs=RAY_M)
    # from the flange: fingers start at 7 cm and are 8 cm long, the tool point is at 14.13 cm
    assert gripper.tip_height_m(0.02) == pytest.approx(0.1413 - (0.07 + 0.047 + 0.033), abs=1.5e-3)
    assert gripper.palm_height_m == pytest.approx(0.1413 - 0.069, abs=1.5e-3)


def test_tip_arc_of_the_robotiq_agrees_with_its_linkage():
    gripper = measured_gripper(ROBOTS["ur5_robotiq"])
    crank, rest = math.hypot(0.00465, 0.05693), math.atan2(0.00465, 0.05693)
    for i, angle in enumerate(0.1 * k for k in range(9)):
        gap, height = gripper.tip_arc[i]
        # driver, finger and pad; the pad extends inwards by 8 mm from its centre at 17.95 mm
        expected_gap = 0.0306 + crank * math.sin(angle - rest) - 0.01795 - 0.008
        reach = 0.0549 + crank * math.cos(angle - rest) + 0.0316 + 0.0196
        assert gap == pytest.approx(expected_gap, abs=RAY_M)
        assert height == pytest.approx(0.1543 - reach, abs=1.5e-3)
    assert gripper.tip_height_m(gripper.half_gap_m) - gripper.tip_height_m(0.0) > 0.013


def test_tip_height_is_interpolated():
    arc, flat = ((0.0, -0.01), (0.04, 0.006)), ((0.0, 0.05),)
    gripper = Gripper(0.04, 0.01, 0.02, 0.05, arc, outline=flat, closed_outline=flat)
    assert gripper.tip_height_m(0.01) == pytest.approx(-0.006)
    assert gripper.tip_height_m(0.1) == pytest.approx(0.006)


@pytest.mark.parametrize("opening", [0.0, 0.6])
def test_the_tip_points_are_those_of_the_closing_fingers(name, opening):
    gripper = measured_gripper(ROBOTS[name])
    widest = max(opening * gripper.half_gap_m, gripper.tip_arc[0][0])
    depth = gripper.finger_depth_m
    points = gripper.tip_points(tool_rotation(0.0), opening).round(9)
    expected = {
        (side * (min(gap, widest) + offset), edge * gripper.half_width_m, tip + height)
        for gap, tip in gripper.tip_arc
        for offset, height in [
            (0.0, 0.0),
            (depth / 2, 0.0),
            *((depth, steps * GRASP_HEIGHT_M) for steps in (0, 1, 2)),
        ]
        for side in (-1, 1)
        for edge in (-1, 0, 1)
    }
    assert {tuple(point) for point in points} == {tuple(np.round(p, 9)) for p in expected}
