"""Poses that the arm cannot reach, or only through the support surface."""

import math

import pybullet
import pytest

from tests.sim.control.ramp_scene import RampScene
from tests.specs import slow_except_two_robots

HORIZONTAL = (0.0, 0.0, math.pi / 2)


def lowest_link_m(robot):
    """Distance of hand and arm from the floor, metres."""
    points = pybullet.getClosestPoints(
        robot.id, robot.world.floor, 0.5, physicsClientId=robot.client
    )
    fingers = frozenset.union(*robot.finger_links)
    distances = (point[8] for point in points if point[3] >= 0 and point[3] not in fingers)
    return min(distances, default=0.5)


@pytest.mark.parametrize("robot", slow_except_two_robots())
@pytest.mark.parametrize("teleport", [True, False])
def test_a_horizontal_tool_near_the_floor_is_out_of_reach(robot, teleport):
    scene = RampScene(robot=robot, teleport=teleport)
    with scene.world:
        hand, lowest = scene.hand, []
        step, teleport_arm = scene.world.step, scene.robot.teleport
        scene.world.step = lambda count=1: (step(count), lowest.append(lowest_link_m(scene.robot)))
        scene.robot.teleport = lambda q: (
            teleport_arm(q),
            lowest.append(lowest_link_m(scene.robot)),
        )
        scene.block.place((0.4, 0.17, scene.half_m))
        scene.world.settle()
        scene.pick(HORIZONTAL)
        assert hand.is_out_of_reach
        assert hand.held is None
        assert min(lowest) > -1e-3
        scene.pick()
        assert not hand.is_out_of_reach
        assert scene.is_held


@pytest.mark.parametrize("teleport", [True, False])
def test_a_place_through_the_slope_is_out_of_reach(teleport):
    """The hand of a tool that points along a slope of 0.5 rad is in the slab."""
    scene = RampScene(teleport=teleport, slope_rad=0.5)
    with scene.world:
        scene.pick((0.0, 0.0, 0.5))
        assert scene.is_held
        scene.hand.surface = SlabSurface(scene)
        scene.place(scene.above_slab(0.0), (0.0, 0.0, 0.5 + math.pi / 2))
        assert scene.hand.is_out_of_reach
        assert scene.is_held
        scene.place(scene.above_slab(0.0), (0.0, 0.0, 0.5))
        assert not scene.hand.is_out_of_reach
        assert not scene.is_held


class SlabSurface:
    """The slab as support surface."""

    def __init__(self, scene):
        self.support_ids = frozenset((scene.slab.id,))

    def lowest_tool_m(self, gripper, xy, rotation=None, opening=1.0):
        return 0.0


@pytest.mark.parametrize("teleport", [True, False])
def test_a_check_for_penetration_does_not_move_the_arm(teleport):
    scene = RampScene(teleport=teleport)
    with scene.world:
        robot = scene.robot
        before = robot.measured_joints()
        target = [0.0] * len(robot.arm_joints)
        robot.penetrates([scene.world.floor], target)
        assert robot.measured_joints() == before
