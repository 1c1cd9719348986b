"""The expert, from initial and from disturbed scenes; heights of picks and places."""

import math

import numpy as np
import pytest
import torch

from ba_torchrl.actions import PICK, PLACE, PickPlaceCommand
from ba_torchrl.sim.bodies import vertical_extent
from ba_torchrl.tasks.open_loop.covid_test import NEW_BOX, SHEET_M
from tests.tasks.open_loop.covid_test.scenes import (
    FIXED,
    carry_out_tests,
    follow,
    lay,
    lay_pair,
    local,
    step,
    wait,
)


@pytest.mark.parametrize("seed", [307, 312])
def test_the_expert_picks_objects_at_a_wall_last(make, seed):
    env = make(max_steps=60)
    state, rng = env.reset(seed=seed), np.random.default_rng(seed - 300)
    for number in range(60):
        action = state["expert_action"].clone()
        if number < 6:
            action[1:3] += torch.tensor(rng.normal(0, 0.015, 2), dtype=torch.float32)
        state = env.step(state.set("action", action))["next"]
        if state["done"]:
            break
    assert not state["truncated"]


@pytest.mark.parametrize("robot", ["panda", "ur5"])
def test_fingers_that_are_wide_above_the_walls_reach_all_new_objects(make, robot):
    env = make(robot=robot)
    for seed in range(5):
        env.reset(seed=seed)
        task = env.scene.task
        assert all(map(task._can_grasp, task.objects))


@pytest.mark.parametrize(
    "config",
    [{}, FIXED, {"action_sequence": "pxyzrrr"}],
    ids=["pxyr", "pxy", "pxyzrrr"],
)
def test_the_expert_succeeds_in_eighteen_steps(make, config):
    env = make(obs_size=128, **config)
    lengths = []
    for _ in range(6):
        env.reset()
        state = follow(env, 1)
        while not state["done"]:
            state = follow(env, 1)
        assert state["success"]
        lengths.append(int(state["step_count"]))
    assert np.median(lengths) == 18
    assert env.faults == 0


def finish(env):
    for _ in range(env.max_steps):
        state = follow(env, 1)
        if state["done"]:
            return state
    return state


def test_the_expert_continues_after_a_misplaced_tube(make):
    env = make(obs_size=128, max_steps=40)
    task = env.scene.task
    lay_pair(task)
    wait(env)
    lay(task, task.tubes[0], task.layout.new_box, (0.0, -0.01), along=0.2)
    assert finish(env)["success"]


def test_the_expert_puts_back_objects_that_it_must_not_present(make):
    env = make(obs_size=128, max_steps=40)
    task = env.scene.task
    lay_pair(task)
    wait(env)
    for body in (task.tubes[1], task.swabs[1]):
        x, y, z = body.position
        step(env, PickPlaceCommand(PICK, x, y, z + 0.003, body.yaw_rad + math.pi / 2))
        assert task.robot.held_body() is body
        follow(env, 1)
        assert task.robot.held_body() is None
        x, y = local(task.layout.new_box, body.position)
        assert abs(x) < NEW_BOX.size[0] / 2
        assert abs(y) < NEW_BOX.size[1] / 2
    assert not task.has_failed
    assert finish(env)["success"]


def test_the_expert_takes_a_fresh_tube_out_of_the_wrong_box(make):
    env = make(obs_size=128, max_steps=40)
    task = env.scene.task
    lay(task, task.tubes[1], task.layout.used_box, (0.0, 0.0), along=0.0)
    assert finish(env)["success"]


def test_expert_actions_after_success_change_nothing(make):
    env = make()
    task = carry_out_tests(env)
    lay(task, task.tubes[2], task.layout.used_box, (0.0, 0.024), along=0.0)
    assert wait(env)["success"]
    command = task.expert_command()
    assert command == task.expert_command()
    where = [tube.position for tube in task.tubes]
    step(env, command)
    assert [tube.position for tube in task.tubes] == [pytest.approx(p, abs=1e-3) for p in where]
    assert task.is_success()


@pytest.mark.parametrize("kind", ["tubes", "swabs"])
def test_heights_from_the_image_fit_thin_objects(make, kind):
    env = make(obs_size=128)
    task = env.scene.task
    body = getattr(task, kind)[1]
    x, y, _ = body.position
    step(env, PickPlaceCommand(PICK, x, y, None, body.yaw_rad + math.pi / 2))
    assert task.robot.held_body() is body
    x, y = task.layout.to_world(task.layout.test_area, (0.0, 0.03))
    seen = []
    place = env.scene.controller.place
    env.scene.controller.place = lambda position, turn: (
        seen.append(position),
        place(position, turn),
    )
    tool, _ = task.robot.tool_pose()
    below = tool[2] - vertical_extent(body)[0]
    step(env, PickPlaceCommand(PLACE, x, y, None, 0.0))
    gap = seen[0][2] - below - SHEET_M
    assert 0 < gap < 0.011  # at most the height of the low rim next to the test area
    assert math.dist(body.position[:2], (x, y)) < 5e-3
    assert vertical_extent(body)[0] == pytest.approx(SHEET_M, abs=5e-4)


def test_picking_a_tube_leaves_its_neighbours_where_they_are(make):
    env = make(obs_size=128)
    for _ in range(5):
        env.reset()
        task = env.scene.task
        where = {body: body.position for body in task.objects}
        follow(env, 1)
        held = task.robot.held_body()
        assert held in task.tubes
        for body, position in where.items():
            if body is not held:
                assert math.dist(body.position, position) < 1e-3
