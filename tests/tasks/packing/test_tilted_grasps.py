"""Grasps and releases of boxes on slopes."""

import math

import numpy as np
import pytest

from ba_torchrl.core import keys
from ba_torchrl.core.actions import PICK, PickPlaceCommand
from ba_torchrl.sim.geometry import (
    quaternion_product,
    rotation_array,
    surface_quaternion,
    tool_rotation,
    yaw_quaternion,
)
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.packing.tilted_grasps import tilted_grasp
from ba_torchrl.tasks.structures.pieces import CUBOID

BUMPS = "bump/box_palletizing"
NORMAL = (math.sin(0.2), 0.0, math.cos(0.2))
ABOVE_M = 0.0145


def grasp(robot, body, others):
    return tilted_grasp(
        robot,
        frozenset(),
        body,
        others,
        above_centre_m=ABOVE_M,
        offsets_m=(0.0, 0.008, -0.008),
        opening=0.7,
    )


@pytest.mark.parametrize("yaw", [0.0, 0.7, math.pi / 2])
def test_a_grasp_without_obstacles_is_parallel_and_central(yaw):
    with World() as world:
        robot = ROBOTS["kuka"](world)
        body = world.add(Box(size_m=(0.045, 0.072, 0.045)), "box")
        body.set_pose((0.45, 0.0, 0.05), surface_quaternion(NORMAL, yaw))
        tool, clearance_m = grasp(robot, body, [])
        assert clearance_m == math.inf
        axes = rotation_array(tool.orientation)
        assert axes[:, 2] == pytest.approx([-n for n in NORMAL], abs=1e-6)
        closing = rotation_array(body.pose.orientation)[:, 0]
        assert abs(axes[:, 0] @ closing) == pytest.approx(1.0)
        expected = np.add(body.position, ABOVE_M * np.array(NORMAL))
        assert tool.position == pytest.approx(expected.tolist(), abs=1e-6)


def test_a_grasp_beside_a_stack_is_inclined_away_from_it():
    with World() as world:
        robot = ROBOTS["panda"](world)
        body = world.add(Box(size_m=(0.045, 0.072, 0.045)), "box")
        stack = world.add(Box(size_m=(0.1, 0.3, 0.2), mass_kg=0.0), "stack")
        body.set_pose((0.45, 0.0, 0.05), surface_quaternion(NORMAL, math.pi / 2))
        stack.place((0.45 + 0.072 / 2 + 0.055, 0.0, 0.1))
        tool, clearance_m = grasp(robot, body, [stack])
        assert clearance_m > 0
        assert rotation_array(tool.orientation)[0, 2] > -0.19  # less than along the normal


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_a_box_that_is_held_obliquely_is_released_level(make_env, seed):
    env = make_env(BUMPS, num_objects=6)
    state = env.reset(seed=seed)
    task = env.scene.task
    body = task.objects[0]
    # oblique by construction: the box turned about its width, held by a vertical tool
    about_width = (math.sin(0.1), 0.0, 0.0, math.cos(0.1))
    x, y, z = body.position
    yaw = CUBOID.yaw_rad(body) % math.pi
    body.set_pose((x, y, z + 0.01), quaternion_product(yaw_quaternion(yaw), about_width))
    pick = env.actions.encode(PickPlaceCommand(PICK, x, y, z + 0.02, yaw))
    state.set(keys.ACTION, env.action_spec.zero() + pick)
    env.step(state)
    held = env.scene.robot.held_body()
    assert held is body
    assert CUBOID.tilt_rad(held) > 0.05
    command = env.actions.decode(env.actions.encode(task.expert_command()))
    in_tool = env.scene.robot.tool_frame().inverse().compose(held.pose)
    rows = np.array(tool_rotation(*command.angles_rad)) @ rotation_array(in_tool.orientation)
    assert np.abs(rows[2, [0, 2]]).max() > math.cos(0.03)
