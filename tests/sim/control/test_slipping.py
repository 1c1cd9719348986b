"""Whether a grasp holds depends on friction and weight, with and without teleports alike."""

import itertools
import math

import pytest

from ba_torchrl.sim.control.pick_place import PickPlaceLimits
from tests.sim.control.ramp_scene import CUBE_M, LONG_M, RampScene

TILT_RAD = 0.5


def holds(*, teleport, tilt_rad=(0.0, 0.0, 0.0), off_center_m=0.0, **options):
    scene = RampScene(teleport=teleport, **options)
    with scene.world:
        scene.pick(tilt_rad, off_center_m)
        return scene.is_held


@pytest.mark.parametrize("teleport", [True, False])
@pytest.mark.parametrize(("friction", "is_held"), [(0.05, False), (0.4, True)])
@pytest.mark.parametrize(
    ("size_m", "tilt_rad", "off_center_m"), [(CUBE_M, 0.0, 0.0), (LONG_M, TILT_RAD, 0.04)]
)
def test_a_grasp_needs_friction(teleport, friction, is_held, size_m, tilt_rad, off_center_m):
    assert is_held == holds(
        teleport=teleport,
        friction=friction,
        size_m=size_m,
        tilt_rad=(0.0, 0.0, tilt_rad),
        off_center_m=off_center_m,
    )


@pytest.mark.parametrize("robot", ["panda", "ur5", "ur5_robotiq"])
def test_no_robot_holds_a_block_without_friction(robot):
    assert not holds(teleport=True, friction=0.0, robot=robot)


@pytest.mark.parametrize("teleport", [True, False])
def test_a_grasp_needs_more_friction_for_a_heavier_block(teleport):
    assert holds(teleport=teleport, friction=0.3, mass_kg=0.1)
    assert not holds(teleport=teleport, friction=0.3, mass_kg=0.5)


@pytest.mark.parametrize("teleport", [True, False])
@pytest.mark.parametrize(("friction", "is_held"), [(0.05, False), (1.0, True)])
def test_a_block_that_lies_on_a_slope_needs_friction(teleport, friction, is_held):
    scene = RampScene(teleport=teleport, slope_rad=0.4, friction=1.0)
    with scene.world:
        scene.set_finger_friction(friction)
        scene.pick((0.0, 0.0, 0.4))
        assert scene.is_held == is_held


def steps_of_a_pick(friction):
    scene = RampScene(friction=friction)
    with scene.world:
        before = scene.world.steps
        scene.pick()
        return scene.world.steps - before


def test_only_a_body_that_slips_is_carried_by_simulation():
    slipping, held = steps_of_a_pick(0.2), steps_of_a_pick(1.0)
    limits = PickPlaceLimits()
    assert held < 30
    retreat_steps = math.sqrt(limits.approach_distance_m / limits.held_acceleration_m_s2) * 240
    assert slipping > held + retreat_steps


FRICTIONS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 1.0)
GRASPS = (
    *((size, tilt, 0.0, 0.0) for size in (CUBE_M, LONG_M) for tilt in (0.0, 0.25, 0.5, 0.75)),
    *((LONG_M, tilt, 0.0, off) for tilt in (0.0, 0.5) for off in (0.02, 0.04)),
    *((size, 0.0, slope, 0.0) for size in (CUBE_M, LONG_M) for slope in (0.2, 0.35, 0.5)),
    *((size, slope, slope, 0.0) for size in (CUBE_M, LONG_M) for slope in (0.2, 0.35, 0.5)),
)


@pytest.mark.slow
def test_grasps_hold_with_and_without_teleports_alike():
    """Of friction, tilt of the tool, slope of the support, and distance from the centre."""
    differing = []
    for friction, (size, tilt, slope, off) in itertools.product(FRICTIONS, GRASPS):
        held = []
        for teleport in (True, False):
            scene = RampScene(teleport=teleport, slope_rad=slope, size_m=size)
            with scene.world:
                scene.set_finger_friction(friction)
                scene.pick((0.0, 0.0, tilt), off)
                held.append(scene.is_held)
        if held[0] != held[1]:
            differing.append((friction, size, tilt, slope, off, held))
    assert len(differing) <= 0.04 * len(FRICTIONS) * len(GRASPS), differing
    assert all(0.05 < friction < 0.3 for friction, *_ in differing), differing
