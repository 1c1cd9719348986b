"""One episode: the initial heap, success and termination, pick heights."""

import pytest
import torch

from ba_torchrl.actions import PICK, PLACE
from ba_torchrl.tasks.terrain.tray import FLOOR_Z_M
from tests.tasks.open_loop.object_grasping.heaps import CENTER, NO_OP, play, with_brick


@pytest.mark.parametrize("hit", [True, False])
def test_an_episode_is_one_pick_and_ends_terminated(make, hit):
    env, state = with_brick(make)
    z = 0.025 if hit else 0.15
    state = env.step(state.set("action", torch.tensor([PICK, *CENTER, z, 0.0])))["next"]
    assert state["success"] == hit
    assert state["holding"] == hit
    assert state["reward"] == float(hit)
    assert state["terminated"]
    assert not state["truncated"]
    assert bool(state["in_hand"].any()) == hit


def test_max_steps_is_the_number_of_attempts(make):
    env = make(max_steps=3, expert=True)
    state = env.reset()
    for last in (False, False, True):
        state = env.step(state.set("action", NO_OP))["next"]
        assert bool(state["terminated"]) == last
        assert not state["truncated"]
    state = env.step(env.reset().set("action", NO_OP))["next"]
    state = play(env, state)
    assert state["success"]
    assert state["step_count"] == 2


@pytest.mark.parametrize(
    "action",
    [
        (PICK, 0.45, 0.075, 0.025, 0.0),  # beyond its end
        (PICK, 0.53, 0.0, 0.025, 0.0),  # beside it
        (PICK, 0.45, 0.0, 0.07, 0.0),  # above it
        (PLACE, 0.45, 0.0, 0.025, 0.0),
    ],
    ids=["end", "side", "height", "place"],
)
def test_a_near_miss_is_a_failure(make, action):
    env, state = with_brick(make)
    state = env.step(state.set("action", torch.tensor(action, dtype=torch.float32)))["next"]
    assert not state["success"]
    assert not state["holding"]
    assert state["terminated"]
    assert env.scene.task.is_valid()


def test_a_released_object_is_not_a_success(make):
    env, state = with_brick(make)
    env.step(state.set("action", torch.tensor([PICK, *CENTER, 0.025, 0.0])))
    task, motion = env.scene.task, env.scene.controller
    assert task.is_success()
    motion.robot.set_opening(1.0)
    env.scene.world.step(5)
    assert not task.is_success()


def test_the_pick_height_is_below_the_highest_point_between_the_fingers(make):
    task = with_brick(make)[0].scene.task
    palm_height_m = task.robot.gripper.palm_height_m
    # the fingers around the object, the palm above it
    assert 0.005 < 0.1 - task.pick_height_m(0.1, (0.45, 0.0)) < palm_height_m
    # neither the tool nor the fingertips reach the floor of the tray
    assert task.pick_height_m(0.0, (0.45, 0.0)) + task.robot.gripper.tip_height_m(0.02) > FLOOR_Z_M
    assert task.window_m(None) == pytest.approx(task.robot.gripper.half_width_m, abs=4e-3)


def test_a_pick_without_a_height_succeeds(make):
    env = make(object_set="household", num_objects=1, action_sequence="xyr")
    state, pool = env.reset(), env.scene.task.pool
    pool.clear()
    pool.activate(next(body for body in pool.bodies if body.name == "brick"))
    pool.active[0].place((*CENTER, FLOOR_Z_M + 0.02))
    env.scene.world.settle()
    state = env.step(state.set("action", torch.tensor([*CENTER, 0.0])))["next"]
    assert state["success"]
