"""Corner Picking: geometry of the corner, conditions of success, drag and grasp of the expert."""

import math

import numpy as np
import pytest

from tests.tasks.episodes import check_lift, play

TASK = "close_loop/corner_picking"


@pytest.fixture
def env(make_started):
    return make_started(TASK, obs_size=64, expert=True)


def test_the_block_is_flush_with_both_walls(env):
    task = env.scene.task
    for _ in range(10):
        env.reset()
        x, y = task.corner.to_local(*task.block.position[:2])
        assert x == pytest.approx(-0.065, abs=5e-4)
        assert y == pytest.approx(-0.065, abs=5e-4)
        turn = (task.block.yaw_rad - task.corner[2] + math.pi) % (2 * math.pi) - math.pi
        assert abs(turn) < 1e-3
        assert task.block.position[2] == pytest.approx(0.027, abs=5e-4)


def test_base_and_walls_do_not_move_and_the_base_is_smooth(env):
    task, scene = env.scene.task, env.scene
    assert task.base.shape.friction == 0.001
    task.put_corner((0.45, 0.0), 0.0)
    at_rest = [body.pose for body in (task.base, task.walls)]
    scene.controller.reset(((0.42, 0.0, 0.05), 0.0), 0.0)
    scene.controller.move_to((0.3, 0.0, 0.05), 0.0)  # into the wall
    assert scene.robot.tool_pose()[0][0] > 0.36
    scene.world.step(50)
    assert at_rest == [body.pose for body in (task.base, task.walls)]


def test_the_block_stays_in_the_corner_without_contact(env):
    task = env.scene.task
    for _ in range(3):
        env.reset()
        env.scene.world.step(600)
        x, y = task.corner.to_local(*task.block.position[:2])
        assert math.dist((x, y), (-0.065, -0.065)) < 1e-3


def test_random_yaws_cover_the_circle_and_fixed_ones_are_zero(env, make_started):
    yaws = []
    for _ in range(60):
        env.reset()
        yaws.append(env.scene.task.corner[2])
    assert min(yaws) < -2.5
    assert max(yaws) > 2.5
    fixed = make_started(TASK, random_orientation=False)
    for _ in range(5):
        fixed.reset()
        assert fixed.scene.task.corner[2] == 0


@pytest.mark.parametrize("turn", [0.0, math.pi / 4, math.pi / 2])
def test_the_block_cannot_be_grasped_in_the_corner(env, turn):
    scene, task = env.scene, env.scene.task
    task.put_corner((0.45, 0.0), 0.0)
    assert task.clearance_m(turn) < 0
    x, y, z = task.block.position
    scene.controller.reset(((x, y, 0.2), turn))
    for height in (0.15, 0.1, z, z):
        scene.controller.move_to((x, y, height), turn)
    scene.controller.grip(0.0)
    scene.controller.move_to((x, y, 0.18), turn)
    assert not task.is_success()


def test_success_requires_a_grasp_and_fifteen_centimetres(env):
    task = env.scene.task
    task.put_corner((0.45, 0.0), 0.0)
    task.block.place((0.45, 0.0, 0.027))
    assert task.clearance_m(0.0) > 0
    check_lift(env, (0.45, 0.0, 0.027))


def test_the_clearance_is_the_gap_between_fingers_and_walls(env):
    task = env.scene.task
    task.put_corner((0.45, 0.0), 0.7)
    task.block.place((*task.corner.to_world(0.01, -0.02), 0.027), 0.7)
    along = task.robot.gripper.finger_reach_m + 0.0075
    assert task.clearance_m(0.7) == pytest.approx(min(0.1 - along, 0.07 - 0.0095), abs=1e-6)
    assert task.clearance_m(0.7 + math.pi / 2) == pytest.approx(0.07 - along, abs=1e-6)


def test_the_block_is_dragged_by_friction_alone(env):
    """The fingertips stay above the block until it is out of the corner."""
    for _ in range(5):
        state = env.reset()
        scene, task = env.scene, env.scene.task
        while (
            task.clearance_m(task.block.yaw_rad) < 0
            and task.clearance_m(task.block.yaw_rad + math.pi / 2) < 0
        ):
            state = env.step(state.set("action", state["expert_action"]))["next"]
            assert not state["done"]
            if scene.robot.opening() < 0.5:
                top = task.block.position[2] + 0.025
                assert scene.robot.tool_pose()[0][2] > top + 4e-3
            assert task.block.tilt_rad < 0.6  # its edge may catch at a wall


def test_the_expert_drags_a_rotated_block_out_of_the_corner(env):
    solved = 0
    for turn in np.linspace(0.1, 1.4, 10):
        env.reset()
        task = env.scene.task
        yaw = task.corner[2]
        half = 0.025 * (math.cos(turn) + math.sin(turn)) + 1e-3
        task.block.place((*task.corner.to_world(-0.09 + half, -0.09 + half), 0.027), yaw + turn)
        env.scene.world.settle()
        state = env._step(env.full_action_spec.zero())
        solved += bool(play(env, state)["success"])
    assert solved >= 9


def test_the_expert_descends_while_it_moves_and_turns_to_the_press(env):
    scene, task = env.scene, env.scene.task
    env.reset()
    task.put_corner((0.45, 0.0), 0.0)
    scene.controller.grip(0.0)
    scene.controller.move_to((0.45, 0.0, 0.2), 0.0)
    far = task.expert_command()
    x, y = 0.45 + far.dx_m, far.dy_m
    scene.controller.move_to((x + 0.008, y + 0.008, 0.2), 0.2)
    scene.controller.move_to((x + 0.008, y + 0.008, 0.075), 0.2)  # below the top of the walls
    near = task.expert_command()
    assert near.dz_m < -0.005
    assert near.dx_m < -0.005
    assert near.dy_m < -0.005
    assert near.dyaw_rad == pytest.approx(-0.2, abs=0.02)


def test_labels_do_not_change_with_millimetres(env):
    """An image shows heights in steps of 1.5 mm."""
    scene, task = env.scene, env.scene.task
    env.reset()
    task.put_corner((0.45, 0.0), 0.0)
    (x, y, z), offset_m = task.block.position, 0.015
    on_block_z = z + 0.025 + task._tips_below_m

    def command(above_m, aside_m=0.0):
        scene.controller.reset(((x + offset_m + aside_m, y, on_block_z + above_m), 0.0), 0.0)
        return task.expert_command()

    for above_m in (-2e-3, 0.0, 2e-3):  # on the block, it drags away from both walls
        for aside_m in (-5e-3, 0.0, 5e-3):
            assert min(command(above_m, aside_m)[1:3]) > 0.04
    for above_m in (8e-3, 0.012):  # above it, it presses deeper than any error of the height
        assert command(above_m).dz_m == pytest.approx(-above_m - 8e-3, abs=1e-3)


@pytest.mark.parametrize("turn", [0.0, 0.7, math.pi / 2])
def test_open_fingers_turn_by_at_most_an_eighth_of_a_circle(env, turn):
    """At a quarter, the two directions are equally far."""
    scene, task = env.scene, env.scene.task
    env.reset()
    task.put_corner((0.45, 0.0), 0.0)
    for xy in ((-0.045, 0.0), (0.0, -0.045), (0.02, 0.02)):  # of clearance at one yaw, at both
        task.block.place((*task.corner.to_world(*xy), 0.027), 0.0)
        x, y, z = task.block.position
        scene.controller.reset(((x, y, z + 0.06), turn))
        command = task.expert_command()
        assert abs(command.dyaw_rad) <= math.pi / 4 + 1e-6


def test_open_fingers_around_the_block_close(env):
    """Also in a position that leaves less than the margin of a descent."""
    scene, task = env.scene, env.scene.task
    env.reset()
    task.put_corner((0.45, 0.0), 0.0)
    task.block.place((*task.corner.to_world(0.02, 0.02), 0.027), 0.0)
    x, y, z = task.block.position
    scene.controller.reset(((x + 0.012, y + 0.015, z + 3e-3), 0.1))
    assert task.expert_command().opening == 0.0
