"""Picks from a slope and places on it, with and without teleports alike."""

import math

import pytest

from tests.sim.control.ramp_scene import RampScene

GENTLE_RAD, STEEP_RAD = 0.2, 0.5
ON_FLOOR_M = (0.4, 0.17, 0.015)


def placed(teleport, slope_rad, tilt_rad, gap_m):
    """Release a block above a slope; return its final position, tilt and depth."""
    scene = RampScene(teleport=teleport, slope_rad=slope_rad)
    with scene.world:
        scene.block.place(ON_FLOOR_M)
        scene.world.settle()
        scene.pick()
        assert scene.is_held
        scene.place(scene.above_slab(gap_m), (0.0, 0.0, tilt_rad))
        assert not scene.is_held
        return scene.block.position, scene.tilt_deg, scene.depth_m


@pytest.mark.parametrize(
    ("slope_rad", "tilt_rad", "gap_m", "stays"),
    [
        (GENTLE_RAD, GENTLE_RAD, 0.0, True),
        (GENTLE_RAD, GENTLE_RAD, 0.02, True),
        (GENTLE_RAD, 0.0, 0.02, True),
        (GENTLE_RAD, -0.1, 0.0, True),
        (STEEP_RAD, STEEP_RAD, 0.02, True),
        (STEEP_RAD, -0.25, 0.02, False),  # it lands on its lower edge and tumbles to the floor
    ],
)
def test_a_block_released_above_a_slope_falls(slope_rad, tilt_rad, gap_m, stays):
    outcomes = [placed(teleport, slope_rad, tilt_rad, gap_m) for teleport in (True, False)]
    for _, tilt_deg, depth_m in outcomes:
        if stays:
            assert tilt_deg == pytest.approx(math.degrees(slope_rad), abs=1.5)
        else:
            assert min(tilt_deg, abs(tilt_deg - 90), 180 - tilt_deg) < 2
        assert depth_m < 1e-3
    positions = [position for position, _, _ in outcomes]
    # one that tumbles may come to rest a quarter turn earlier or later
    assert math.dist(*positions) < (8e-3 if stays else 0.04)


@pytest.mark.parametrize(
    ("slope_rad", "yaw_rad"), [(GENTLE_RAD, 0.6), (STEEP_RAD, 0.0), (STEEP_RAD, math.pi / 2)]
)
def test_a_vertical_tool_picks_a_block_that_lies_on_a_slope(slope_rad, yaw_rad):
    """A finger that touches the slope stops the closing until the tool is lifted."""
    poses = []
    for teleport in (True, False):
        scene = RampScene(teleport=teleport, slope_rad=slope_rad)
        with scene.world:
            scene.pick((yaw_rad, 0.0, 0.0))
            assert scene.is_held
            poses.append((scene.block.position, scene.tilt_deg))
    assert math.dist(poses[0][0], poses[1][0]) < 0.015
    assert poses[0][1] == pytest.approx(poses[1][1], abs=6)


@pytest.mark.parametrize("teleport", [True, False])
def test_a_block_that_is_not_held_is_released_above_the_target(teleport):
    """The fingers close on a corner; the block stays near its initial position."""
    scene = RampScene(teleport=teleport, slope_rad=0.0)
    with scene.world:
        x, y, z = scene.block.position
        scene.pick((math.pi / 4, 0.0, 0.0), off_center_m=0.02)
        assert not scene.is_held
        assert math.dist(scene.block.position[:2], (x, y)) < 0.05
        assert scene.block.position[2] == pytest.approx(z, abs=2e-3)
