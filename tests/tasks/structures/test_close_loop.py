"""Close-loop Block Stacking and House Building; open-loop stacks of cylinders."""

import math

import numpy as np
import pytest
import torch

from ba_torchrl.demonstrations.time_reversal import replay_scores
from ba_torchrl.sim.bodies import vertical_extent, world_vertices
from ba_torchrl.tasks.structures.pieces import CYLINDER
from ba_torchrl.testing import tasks as checks
from tests.tasks.episodes import play_scene

STACKING, HOUSE = "close_loop/block_stacking", "close_loop/house_building"
OPEN_STACKING = "open_loop/block_stacking"
FIXED = {"random_orientation": False, "action_sequence": "pxyz"}
OPEN_FIXED = {**FIXED, "action_sequence": "pxy"}


def cubes_of(task):
    return [body for body, piece in task.structure.pieces.items() if piece.kind == "cube"]


def triangle_of(task):
    return next(b for b, piece in task.structure.pieces.items() if piece.kind == "triangle")


def no_op(env):
    """Take a step in which the open gripper does not move."""
    action = torch.zeros(env.action_spec.shape)
    action[0] = 1.0
    return env._step(env.full_action_spec.zero().set("action", action))


# -- pieces ------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", [STACKING, HOUSE])
def test_the_number_of_pieces_is_configurable(make_started, task):
    for count in (2, 3, 4):
        env = make_started(task, num_objects=count)
        for _ in range(3):
            env.reset()
            points = [body.position[:2] for body in env.scene.task.objects]
            assert len(points) == count
            apart = [math.dist(a, b) for i, a in enumerate(points) for b in points[:i]]
            assert min(apart) > 0.099


def test_with_fixed_orientations_the_fingers_face_the_ends_of_the_triangle(make_started):
    env = make_started(HOUSE, **FIXED)
    for _ in range(3):
        env.reset()
        task = env.scene.task
        assert cubes_of(task)[0].yaw_rad == pytest.approx(0.0, abs=1e-3)
        assert triangle_of(task).yaw_rad == pytest.approx(math.pi / 2, abs=1e-3)


def test_a_triangle_held_by_its_ends_stays_level(make_started):
    scene = make_started(HOUSE).scene
    task = scene.task
    task.stand(cubes_of(task)[0], (0.35, 0.1), 0.0)
    task.stand(triangle_of(task), (0.45, 0.0), math.pi / 2)
    scene.controller.reset(((0.45, 0.0, 0.1), 0.0))
    scene.world.settle()
    scene.controller.move_to((0.45, 0.0, 0.025), 0.0)
    scene.controller.grip(0.0)
    for z in (0.075, 0.125):
        scene.controller.move_to((0.45, 0.0, z), 0.0)
    assert scene.robot.held_body() is triangle_of(task)
    assert vertical_extent(triangle_of(task))[0] > 0.09
    assert triangle_of(task).tilt_rad < 0.05


# -- success -----------------------------------------------------------------------------------


def test_stacking_succeeds_only_after_the_release(make_started):
    env = make_started(STACKING)
    scene = env.scene
    lower, upper = cubes_of(scene.task)
    lower.place((0.45, 0.0, 0.025))
    upper.place((0.4, 0.1, 0.025))
    scene.controller.reset(((0.4, 0.1, 0.1), 0.0))
    scene.world.settle()
    scene.controller.move_to((0.4, 0.1, 0.025), 0.0)
    scene.controller.grip(0.0)
    for target in ((0.4, 0.1, 0.1), (0.45, 0.0, 0.1), (0.45, 0.0, 0.0745)):
        scene.controller.move_to(target, 0.0)
    assert scene.robot.held_body() is upper
    assert all(scene.task.structure.assigner(held=None).evaluate().values())
    assert not scene.task.is_success()
    scene.controller.grip(1.0)
    scene.world.settle()
    assert scene.task.is_success()


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        ((0.45, 0.02, 0.079), True),  # falls onto the lower cube
        ((0.45, 0.028, 0.075), False),  # tips over
    ],
)
def test_stacking_is_evaluated_at_rest(make_started, position, expected):
    env = make_started(STACKING)
    lower, upper = cubes_of(env.scene.task)
    env.scene.controller.reset(((0.35, -0.1, 0.2), 0.0))
    lower.place((0.45, 0.0, 0.025))
    upper.place(position)
    env.scene.world.settle()
    outcome = no_op(env)
    assert outcome["success"] == expected
    assert outcome["terminated"] == expected
    assert outcome["reward"] == float(expected)


def test_a_tipped_triangle_ends_the_episode_without_reward(make_started, monkeypatch):
    env = make_started(HOUSE)
    task, triangle = env.scene.task, triangle_of(env.scene.task)
    slope = math.pi - math.atan2(0.05, 0.025)
    for tilt, valid in ((math.pi / 9 - 0.02, True), (math.pi / 9 + 0.02, False), (slope, False)):
        triangle.set_pose((0.45, 0.0, 0.04), (0.0, math.sin(tilt / 2), 0.0, math.cos(tilt / 2)))
        assert task.is_valid() is valid
    with monkeypatch.context() as patch:
        patch.setattr(task.robot, "held_body", lambda: triangle)
        assert task.is_valid()
    env.scene.world.settle()
    assert triangle.tilt_rad > 1.0
    outcome = no_op(env)
    assert outcome["terminated"]
    assert not outcome["success"]
    assert outcome["reward"] == 0


def test_a_cube_may_lie_on_any_side(make_started):
    env = make_started(HOUSE, expert=True)
    task = env.scene.task
    cubes_of(task)[0].set_pose(
        (*cubes_of(task)[0].position[:2], 0.025),
        (math.sin(math.pi / 4), 0, 0, math.cos(math.pi / 4)),
    )
    assert play_scene(env)["success"]


# -- expert ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "count", "variant", "most"),
    [(STACKING, 4, {}, 40), (STACKING, 4, FIXED, 40), (HOUSE, 3, FIXED, 24), (HOUSE, 4, {}, 40)],
)
def test_expert_builds_structures_of_up_to_four_pieces(make_started, task, count, variant, most):
    env = make_started(task, num_objects=count, **variant)
    lengths = []
    for _ in range(5):
        env.reset()
        assert play_scene(env)["success"]
        lengths.append(env._step_count)
    assert np.mean(lengths) <= most


def test_expert_separates_blocks_that_touch(make_started):
    env = make_started(STACKING)
    for yaw in (-0.6, 0.0, 0.4, 0.8):
        env.reset()
        first, second = cubes_of(env.scene.task)
        first.place((0.42, 0.0, 0.025), yaw)
        second.place((0.42 + 0.051 * math.cos(yaw), 0.051 * math.sin(yaw), 0.025), yaw)
        assert play_scene(env)["success"]


def test_expert_removes_a_triangle_in_a_low_slot(make_started):
    env = make_started(HOUSE, num_objects=3)
    task = env.scene.task
    cubes_of(task)[0].place((0.4, -0.05, 0.025), 0.3)
    cubes_of(task)[1].place((0.52, 0.05, 0.025), 0.0)
    triangle_of(task).place((0.4, -0.05, 0.075), 0.3)
    env.scene.world.settle()
    assert play_scene(env)["success"]


def test_expert_releases_a_piece_that_supports_others(make_started):
    env = make_started(HOUSE)
    scene = env.scene
    task = scene.task
    block = cubes_of(task)[0]
    block.place((0.45, 0.0, 0.025))
    triangle_of(task).place((0.35, 0.1, 0.025))
    scene.controller.reset(((0.45, 0.0, 0.1), 0.0))
    scene.controller.move_to((0.45, 0.0, 0.025), 0.0)
    scene.controller.grip(0.0)
    scene.controller.move_to((0.45, 0.0, 0.1), 0.0)
    assert scene.robot.held_body() is block
    assert play_scene(env)["success"]


# -- cylinders ---------------------------------------------------------------------------------


@pytest.fixture
def cylinders(make_started):
    """Return a task whose cylinders stand in a stack."""
    task = make_started(OPEN_STACKING, object_type="cylinder").scene.task
    for level, body in enumerate(task.objects):
        body.place((0.45, 0.0, (level + 0.5) * 0.03), 0.7 * level)
    task.world.settle()
    return task


def test_cylinders_are_as_high_and_wide_as_blocks(cylinders):
    for body in cylinders.objects:
        vertices = body.shape.vertices
        np.testing.assert_allclose(np.hypot(vertices[:, 0], vertices[:, 1]), 0.015)
        np.testing.assert_allclose(np.abs(vertices[:, 2]), 0.015)


def test_fingers_close_on_sides_of_a_cylinder_at_every_grasp_yaw(cylinders):
    body = cylinders.objects[0]
    body.place((0.3, 0.1, 0.015), 0.4)
    yaws = CYLINDER.grasp_yaws(body)
    assert len({round(yaw % math.pi, 6) for yaw in yaws}) == 8
    for yaw in yaws:
        along = (world_vertices(body)[:, :2] - (0.3, 0.1)) @ (math.cos(yaw), math.sin(yaw))
        assert along.max() == pytest.approx(0.015 * math.cos(math.pi / 16))
        assert (along > along.max() - 1e-9).sum() == 4  # the corners of a side


def test_cylinders_may_stand_on_either_end(cylinders):
    assert cylinders.is_success()
    top = cylinders.objects[-1]
    top.set_pose(top.position, (1.0, 0.0, 0.0, 0.0))
    cylinders.world.settle()
    assert cylinders.is_success()
    assert cylinders.is_valid()


LYING = (0.0, math.sin(math.pi / 4), 0.0, math.cos(math.pi / 4))
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("position", "orientation"),
    [
        ((0.45, 0.031, 0.015), UPRIGHT),  # beside the stack
        ((0.48, 0.1, 0.015), UPRIGHT),
        ((0.45, 0.0, 0.1051), LYING),  # on top
        ((0.35, 0.1, 0.0151), LYING),
    ],
)
def test_a_cylinder_off_the_stack_is_no_success_and_on_its_side_ends_the_episode(
    cylinders, position, orientation
):
    cylinders.objects[-1].set_pose(position, orientation)
    cylinders.world.step(2)
    assert cylinders.objects[-1].position[2] == pytest.approx(position[2], abs=1e-3)
    assert not cylinders.is_success()
    assert cylinders.is_valid() == (orientation == UPRIGHT)


@pytest.mark.parametrize(("settings", "steps"), [(OPEN_FIXED, 6), ({"num_objects": 6}, 10)])
def test_expert_stacks_cylinders_in_the_fewest_steps(settings, steps):
    cylinders = {"object_type": "cylinder", **settings}
    checks.check_expert(
        OPEN_STACKING, episodes=5, min_success_rate=1.0, max_typical_steps=steps, **cylinders
    )


def test_the_reversed_deconstruction_builds_a_stack_of_cylinders():
    scores = replay_scores(OPEN_STACKING, 5, object_type="cylinder")
    assert scores.reversible * scores.success_rate >= 0.8


def test_expert_removes_a_tower_that_blocks_the_grasp_of_the_last_cube(make_started):
    env = make_started(OPEN_STACKING, expert=True, max_steps=20)
    cubes = env.scene.task.objects
    for level, cube in enumerate(cubes[:3]):
        cube.place((0.394, 0.046, (level + 0.5) * 0.03), 1.2)
    cubes[3].place((0.362, 0.055, 0.015), 1.228)
    assert play_scene(env)["success"]
    assert env._step_count <= 12


@pytest.mark.parametrize(
    ("robot", "gap_m"), [("kuka", 0.01), ("kuka", 0.025), ("panda", 0.001), ("panda", 0.025)]
)
def test_expert_without_yaw_stacks_cubes_that_stand_side_by_side(make_started, robot, gap_m):
    """In a row along the closing direction, cubes block the centred grasps of their neighbours."""
    config = {"expert": True, "max_steps": 30, "num_objects": 3, **OPEN_FIXED}
    env = make_started(OPEN_STACKING, robot=robot, **config)
    for i, cube in enumerate(env.scene.task.objects):
        cube.place((0.42 + i * (0.03 + gap_m), 0.02, 0.015))
    assert play_scene(env)["success"]
    assert env._step_count <= 20
