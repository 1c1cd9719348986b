"""Tests in order: what counts as one, what breaks the order, and success."""

import math

import pytest

from ba_torchrl.sim.bodies import vertical_extent
from ba_torchrl.sim.geometry import downward
from ba_torchrl.tasks.open_loop.covid_test import SHEET_M, USED_BOX, WALL_M
from tests.tasks.open_loop.covid_test.scenes import (
    carry_out_tests,
    follow,
    lay,
    lay_pair,
    local,
    misplace,
    wait,
)


def test_a_pair_in_the_test_area_becomes_a_test(make):
    env = make()
    task = env.scene.task
    lay_pair(task, tube=1, swab=2)
    before = env._heightmap(env.scene)
    state = wait(env)
    assert not state["done"]
    assert task.get_state().used_tubes == (1,)
    assert task.get_state().used_swabs == (2,)
    assert task.swabs[2].is_hidden
    assert task.swabs[2] not in task.objects
    assert len(task.objects) == 5
    x, y = local(task.layout.test_area, task.tubes[1].position)
    assert abs(x) < 0.0126
    assert abs(y) < 0.1001
    assert (x, y) != pytest.approx((0.0, 0.06), abs=1e-3)  # it has a new pose
    assert env.scene.world.is_still()
    after = env._heightmap(env.scene)
    lost = (before > 0.006).sum() - (after > 0.006).sum()
    assert lost == pytest.approx(0.07 * 0.01 / env.pixel_m**2, rel=0.35)  # the pixels of the swab


def test_swab_and_tube_come_in_any_order_and_one_alone_is_not_a_test(make):
    for first, second in ((0, 1), (1, 0)):
        env = make()
        task = env.scene.task
        bodies, spots = (task.tubes[0], task.swabs[0]), ((0.0, 0.06), (0.0, -0.06))
        lay(task, bodies[first], task.layout.test_area, spots[first])
        assert not wait(env)["done"]
        assert task.get_state()[1:] == ((), (), False)
        lay(task, bodies[second], task.layout.test_area, spots[second])
        assert not wait(env)["done"]
        assert task.get_state()[1:] == ((0,), (0,), False)


def test_poses_of_used_tubes_are_random_and_depend_on_the_seed(make):
    spots = []
    for seed in (0, 1, 2, 0):
        env = make(seed=seed)
        task = env.scene.task
        lay_pair(task)
        wait(env)
        spots.append((*local(task.layout.test_area, task.tubes[0].position), task.tubes[0].yaw_rad))
    assert spots[0] == spots[3]
    assert len(set(spots)) == 3


def test_a_used_tube_is_placed_clear_of_other_objects(make):
    env = make()
    task = env.scene.task
    for attempt in range(6):
        env.reset()
        lay_pair(task)
        # their centres are outside the test area, but they extend far into it
        side = math.copysign(0.0585, local(task.layout.new_box, task.layout.test_area.position)[0])
        lay(task, task.tubes[1], task.layout.test_area, (side, 0.03), along=0.0)
        lay(task, task.tubes[2], task.layout.test_area, (side, -0.03), along=0.0)
        where = [tube.position for tube in task.tubes[1:]]
        assert not wait(env)["done"], attempt
        assert task.get_state().used_tubes == (0,)
        for tube, position in zip(task.tubes[1:], where, strict=True):
            assert math.dist(tube.position, position) < 2e-3
        assert vertical_extent(task.tubes[0])[0] == pytest.approx(SHEET_M, abs=5e-4)


def test_a_held_object_above_the_test_area_is_not_presented(make):
    env = make()
    task = env.scene.task
    follow(env, 1)
    held = task.robot.held_body()
    assert held in task.tubes
    x, y = task.layout.to_world(task.layout.test_area, (0.0, 0.0))
    joints = task.robot.inverse_kinematics((x, y, 0.1), downward(0.0))
    env.scene.controller._teleport(joints)
    env.scene.world.step(2)
    assert math.dist(held.position[:2], (x, y)) < 0.02
    assert task.robot.held_body() is held
    assert not task._is_presented(held)


def test_a_swab_in_the_used_box_is_not_a_failure(make):
    env = make()
    task = env.scene.task
    lay(task, task.swabs[0], task.layout.used_box, (0.0, 0.0), along=0.0)
    assert not wait(env)["done"]


def expect_failure(env):
    state = wait(env)
    assert env.scene.task.has_failed
    assert state["terminated"]
    assert state["done"]
    assert not state["truncated"]
    assert not state["success"]
    assert state["reward"] == 0.0


@pytest.mark.parametrize("kind", ["tubes", "swabs"])
def test_two_of_a_kind_in_the_test_area_fail(make, kind):
    env = make()
    task = env.scene.task
    for body, y in zip(getattr(task, kind), (0.06, -0.06), strict=False):
        lay(task, body, task.layout.test_area, (0.0, y))
    expect_failure(env)


def test_two_swabs_and_a_tube_fail(make):
    env = make()
    task = env.scene.task
    lay_pair(task)
    lay(task, task.swabs[1], task.layout.test_area, (0.03, -0.06))
    expect_failure(env)


def test_a_swab_beside_an_uncollected_used_tube_fails(make):
    env = make()
    task = env.scene.task
    lay_pair(task)
    assert not wait(env)["done"]
    lay(task, task.tubes[0], task.layout.test_area, (0.0, 0.06))
    lay(task, task.swabs[1], task.layout.test_area, (0.0, -0.06))
    expect_failure(env)


def test_a_fresh_tube_beside_an_uncollected_used_tube_fails(make):
    env = make()
    task = env.scene.task
    lay_pair(task)
    assert not wait(env)["done"]
    lay(task, task.tubes[0], task.layout.test_area, (0.0, 0.06))
    lay(task, task.tubes[1], task.layout.test_area, (0.0, -0.06))
    expect_failure(env)


@pytest.mark.parametrize("where", ["new_box", "across the rim", "beside"])
def test_a_pair_before_the_used_tube_is_in_its_box_fails(make, where):
    env = make()
    task = env.scene.task
    lay_pair(task)
    assert not wait(env)["done"]
    misplace(task, task.tubes[0], where)
    assert not wait(env)["done"]  # it may be anywhere outside the test area
    lay_pair(task, 1, 1)
    expect_failure(env)


def test_a_collected_tube_is_not_tested_again(make):
    env = make()
    task = env.scene.task
    lay_pair(task)
    wait(env)
    lay(task, task.tubes[0], task.layout.used_box, (0.0, 0.0), along=0.0)
    assert not wait(env)["done"]
    lay_pair(task, 0, 1)
    expect_failure(env)


def test_an_object_outside_the_workspace_ends_the_episode(make):
    env = make()
    task = env.scene.task
    task.swabs[0].place((0.7, 0.0, 0.005), 0.0)
    state = wait(env)
    assert state["terminated"]
    assert not state["success"]
    assert not task.has_failed


def test_three_used_tubes_in_their_box_are_a_success(make):
    env = make()
    task = carry_out_tests(env)
    assert not task.is_success()
    lay(task, task.tubes[2], task.layout.used_box, (0.0, 0.024), along=0.0)
    state = wait(env)
    assert state["success"]
    assert state["terminated"]
    assert state["reward"] == 1.0


@pytest.mark.parametrize("where", ["new_box", "across the rim", "beside", "test area"])
def test_the_last_tube_elsewhere_is_not_a_success(make, where):
    env = make()
    task = carry_out_tests(env)
    if where != "test area":
        misplace(task, task.tubes[2], where)
    state = wait(env)
    assert not state["success"]
    assert not state["done"]


def test_a_tube_across_the_rim_is_not_in_the_box(make):
    env = make()
    task = carry_out_tests(env)
    misplace(task, task.tubes[2], "across the rim")
    wait(env)
    x, y = local(task.layout.used_box, task.tubes[2].position)
    assert abs(x) < USED_BOX.size[0] / 2 - WALL_M
    assert abs(y) < USED_BOX.size[1] / 2 - WALL_M
    assert vertical_extent(task.tubes[2])[0] > USED_BOX.size[2] - 2e-3
    assert not task.is_collected(task.tubes[2])


def test_fresh_tubes_in_the_used_box_are_not_a_success(make):
    env = make()
    task = env.scene.task
    for tube, y in zip(task.tubes, (-0.024, 0.0, 0.024), strict=True):
        lay(task, tube, task.layout.used_box, (0.0, y), along=0.0)
    assert all(map(task.is_collected, task.tubes))
    state = wait(env)
    assert not state["success"]
    assert not state["done"]


def test_a_tube_in_the_gripper_is_not_collected(make):
    env = make()
    task = carry_out_tests(env)
    follow(env, 1)
    assert task.robot.held_body() is task.tubes[2]
    assert not task.is_success()
    assert follow(env, 1)["success"]
