"""Conditions of success on both sides of their thresholds; invalid scenes; random initial poses."""

import math
import re

import numpy as np
import pytest

from tests.tasks.episodes import check_lift


@pytest.fixture
def make(make_started):
    return lambda task, **config: make_started(f"close_loop/{task}", **config)


def test_reaching_succeeds_within_three_centimetres(make):
    env = make("block_reaching")
    scene = env.scene
    scene.task.block.place((0.45, 0.0, 0.025))
    for z, expected in ((0.025 + 0.031, False), (0.025 + 0.029, True)):
        scene.controller.reset(((0.45, 0.0, z), 0.0))
        assert scene.task.is_success() is expected


def test_picking_requires_a_grasp_and_a_height(make):
    env = make("block_picking")
    env.scene.task.block.place((0.45, 0.0, 0.025))
    check_lift(env, (0.45, 0.0, 0.025), low_m=0.14, high_m=0.16)


def test_pushing_succeeds_within_five_centimetres(make):
    env = make("block_pushing")
    task = env.scene.task
    task.goal.place((0.45, 0.0, 0.0))
    for distance, expected in ((0.051, False), (0.049, True)):
        task.block.place((0.45 + distance * math.cos(1.0), distance * math.sin(1.0), 0.025))
        assert task.is_success() is expected


def test_pulling_requires_contact(make):
    env = make("block_pulling")
    scene = env.scene
    first, second = scene.task.blocks
    first.place((0.4, 0.0, 0.025))
    for gap, expected in ((0.003, False), (-1e-4, True)):
        second.place((0.4 + 0.08 + gap, 0.0, 0.025))
        scene.world.step(2)
        assert scene.task.is_success() is expected


def test_an_object_that_leaves_the_workspace_terminates_without_reward(make):
    env = make("block_picking")
    env.scene.task.block.place((0.45, 0.16, 0.025))
    outcome = env._step(env.full_action_spec.zero())
    ends = {name: bool(outcome[name]) for name in ("terminated", "done", "success", "reward")}
    assert ends == {"terminated": True, "done": True, "success": False, "reward": False}


@pytest.mark.parametrize("check", ["point", "bounding_box"])
@pytest.mark.parametrize(
    ("position", "message"),
    [
        ((0.45, 0.0, 0.01), None),  # as the origin of a flat body on the floor
        ((0.45, 0.0, 0.004), None),
        ((0.45, 0.16, 0.025), r"'block' at y = 0\.1\d+ m, above 0\.15 m"),
        ((0.29, 0.0, 0.025), r"'block' at x = 0\.2\d+ m, below 0\.3 m"),
        ((0.45, 0.0, 0.26), r"'block' at z = 0\.2\d+ m, above 0\.25 m"),
        ((0.45, 0.0, -0.06), r"'block' at z = -0\.0\d+ m, below -0\.05 m"),
    ],
)
def test_objects_outside_the_workspace_are_named_with_axis_and_value(
    make, check, position, message
):
    task = make("block_picking", workspace_check=check).scene.task
    task.block.place(position)
    assert task.is_valid() is (message is None)
    assert [bool(re.fullmatch(message or "", text)) for text in task.outside()] == (
        [] if message is None else [True]
    )


def test_the_bounding_box_of_a_bowl_does_not_depend_on_its_yaw(make):
    task = make("block_in_bowl", workspace_check="bounding_box").scene.task
    task.block.place((0.35, 0.1, 0.025))
    for yaw_rad in (0.0, 0.3, 0.8, 1.2):
        for x, valid in ((0.49, True), (0.53, False)):
            task.bowl.place((x, 0.0, 1e-3), yaw_rad)
            assert task.is_valid() is valid


def test_fixed_orientations_are_at_yaw_zero(make):
    env = make("block_pulling", random_orientation=False)
    for _ in range(5):
        env.reset()
        first, second = env.scene.task.blocks
        assert abs(first.yaw_rad) < 1e-3
        assert abs(second.yaw_rad) < 1e-3
        assert first.position[0] == pytest.approx(second.position[0], abs=1e-3)


def test_scales_are_drawn_in_steps_and_visible_in_the_image(make):
    env = make("block_picking", object_scale_range=(0.8, 0.9))
    seen = set()
    for _ in range(30):
        state = env.reset()
        edge = env.scene.task.block.shape.size_m[0]
        seen.add(round(edge / 0.05, 4))
        depth = state["depth"]
        assert float(depth.max() - depth[depth > 0].min()) == pytest.approx(edge, abs=1e-3)
    assert seen == {0.8, 0.82, 0.84, 0.86, 0.88, 0.9}


def test_positions_cover_the_workspace_up_to_the_padding(make):
    env = make("block_picking")
    points = []
    for _ in range(300):
        env.reset()
        points.append(env.scene.task.block.position[:2])
    points = np.array(points)
    low, high = points.min(axis=0), points.max(axis=0)
    np.testing.assert_allclose(low, (0.36, -0.09), atol=5e-3)
    np.testing.assert_allclose(high, (0.54, 0.09), atol=5e-3)
