"""Pick and place commands against homogeneous matrices."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ba_torchrl.core.actions import PICK, PLACE, OpenLoopActions
from ba_torchrl.sim.geometry import Pose, carrying_pose, downward_pose
from ba_torchrl.tasks.manipulation.pick_place_commands import (
    LEVEL_RAD,
    no_op,
    pick_command,
    place_command,
    swaps_fingers,
)
from ba_torchrl.tasks.workspace import Workspace
from tests.sim.test_geometry import FLIP, homogeneous


def pose_of(position, rz, ry=0.0, rx=0.0, flip=False):
    turn = Rotation.from_euler("ZYX", (rz, ry, rx))
    return Pose(position, tuple((turn * FLIP if flip else turn).as_quat().tolist()))


@pytest.mark.parametrize("angles", [(0.3, 0.0, 0.0), (-2.0, 0.4, -0.7), (3.0, -0.1, 0.2)])
def test_a_pick_has_the_pose_of_the_tool(angles):
    command = pick_command(pose_of((0.4, 0.1, 0.05), *angles, flip=True))
    assert command.primitive == PICK
    assert command[1:4] == (0.4, 0.1, 0.05)
    assert command.angles_rad == pytest.approx(angles)
    assert pick_command(downward_pose((0.4, 0.1, 0.05), 1.3)).angles_rad == pytest.approx(
        (1.3, 0.0, 0.0)
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_held_body_moves_rigidly_with_the_tool(seed):
    rng = np.random.default_rng(seed)
    tool = pose_of(tuple(rng.normal(size=3)), *rng.uniform(-1, 1, 3), flip=True)
    held, target = (pose_of(tuple(rng.normal(size=3)), *rng.uniform(-1, 1, 3)) for _ in range(2))
    goal = carrying_pose(tool, held, target)
    in_tool = np.linalg.inv(homogeneous(tool)) @ homogeneous(held)
    np.testing.assert_allclose(homogeneous(goal) @ in_tool, homogeneous(target), atol=1e-12)


def test_a_place_on_a_slope_tilts_the_tool():
    tool = pose_of((0.5, 0.0, 0.3), 0.4, flip=True)
    held = Pose((0.5, 0.01, 0.28), pose_of((0, 0, 0), 0.4).orientation)
    slope = pose_of((0.4, 0.1, 0.06), 1.0, 0.0, 0.2)
    command = place_command(tool, held, slope)
    assert command.primitive == PLACE
    assert command.angles_rad == pytest.approx((1.0, 0.0, 0.2))
    placed = pose_of(command[1:4], *command.angles_rad, flip=True)
    in_tool = np.linalg.inv(homogeneous(tool)) @ homogeneous(held)
    np.testing.assert_allclose(homogeneous(placed) @ in_tool, homogeneous(slope), atol=1e-12)


def test_a_yaw_rotates_the_held_body_about_the_tool():
    tool, held = downward_pose((0.5, 0.0, 0.3), 0.2), Pose((0.53, 0.0, 0.28))
    command = place_command(tool, held, held.moved_to((0.4, 0.1, 0.02), math.pi / 2))
    # from 3 cm beside the tool along x to 3 cm along y
    assert command[1:4] == pytest.approx((0.4, 0.07, 0.04))
    assert command.rz_rad == pytest.approx(0.2 + math.pi / 2)


def test_small_tilts_and_rounding_errors_are_zeroed():
    tilted = pose_of((0.4, 0.0, 0.1), -1e-12, 0.9 * LEVEL_RAD, -0.9 * LEVEL_RAD, flip=True)
    assert pick_command(tilted).angles_rad == (0.0, 0.0, 0.0)
    tilted = pose_of((0.4, 0.0, 0.1), -1e-3, 1.1 * LEVEL_RAD, 0.0, flip=True)
    assert pick_command(tilted).angles_rad == pytest.approx((-1e-3, 1.1 * LEVEL_RAD, 0.0))


def test_a_no_op_is_in_the_corner_of_the_workspace():
    workspace = Workspace(x=(0.2, 0.6), y=(-0.3, 0.1), z=(0.0, 0.4))
    assert no_op(workspace, is_holding=False)[:3] == (PICK, 0.2, -0.3)
    assert no_op(workspace, is_holding=True)[:3] == (PLACE, 0.2, -0.3)


@pytest.mark.parametrize("rz", [-3.0, -0.4, -1e-12, 0.0, 0.4, 3.0])
def test_yaws_outside_of_half_a_turn_swap_the_fingers(rz):
    pose = pose_of((0.4, 0.1, 0.05), rz, 0.2, -0.1, flip=True)
    actions = OpenLoopActions("xyrrr", ((0.2, 0.6), (-0.2, 0.2), (0.0, 0.4)))
    executed = actions.decode(actions.encode(pick_command(pose)))
    assert swaps_fingers(pose) == (executed.ry_rad < 0)
