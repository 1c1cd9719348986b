"""Open-loop object grasping: one episode, pick heights, expert; `test_heap` has the heap."""

import math

import pytest
import torch

from ba_torchrl.core.actions import PICK, PLACE
from ba_torchrl.sim.meshes import box_mesh, write_obj
from ba_torchrl.tasks.terrain.tray import FLOOR_Z_M
from tests.tasks.episodes import play

CENTER = (0.45, 0.0)
NO_OP = torch.tensor([1.0, *CENTER, 0.0])
"""A place with an empty gripper: a failed episode that moves no object."""


@pytest.fixture
def make(make_env):
    config = {"obs_size": 128, "expert": False}
    return lambda **other: make_env("open_loop/object_grasping", **{**config, **other})


@pytest.fixture
def with_brick(make):
    """Return a function that makes a tray with a brick in its middle, 4 cm wide along x."""

    def build(action_sequence="pxyzr"):
        env = make(object_set="household", num_objects=1, action_sequence=action_sequence)
        state, pool = env.reset(), env.scene.task.pool
        brick = next(body for body in pool.bodies if body.name == "brick")
        pool.clear()
        pool.activate(brick)
        brick.place((*CENTER, FLOOR_Z_M + 0.02))
        env.scene.world.settle()
        return env, state

    return build


@pytest.mark.parametrize(
    ("action", "hit"),
    [
        ((PICK, *CENTER, 0.025, 0.0), True),
        ((PICK, *CENTER, 0.15, 0.0), False),
        ((PICK, 0.45, 0.075, 0.025, 0.0), False),  # beyond its end
        ((PICK, 0.53, 0.0, 0.025, 0.0), False),  # beside it
        ((PICK, 0.45, 0.0, 0.07, 0.0), False),  # above it
        ((PLACE, 0.45, 0.0, 0.025, 0.0), False),
        ((*CENTER, 0.0), True),  # at the height from the image
    ],
)
def test_an_episode_is_one_pick_and_ends_terminated(with_brick, action, hit):
    env, state = with_brick("pxyzr" if len(action) == 5 else "xyr")
    state = env.step(state.set("action", torch.tensor(action, dtype=torch.float32)))["next"]
    assert state["success"] == hit
    assert state["holding"] == hit
    assert state["reward"] == float(hit)
    assert state["terminated"]
    assert not state["truncated"]
    assert bool(state["in_hand"].any()) == hit
    assert env.scene.task.is_valid()


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


def test_a_released_object_is_not_a_success(with_brick):
    env, state = with_brick()
    env.step(state.set("action", torch.tensor([PICK, *CENTER, 0.025, 0.0])))
    task, motion = env.scene.task, env.scene.controller
    assert task.is_success()
    motion.robot.set_opening(1.0)
    env.scene.world.step(5)
    assert not task.is_success()


def test_the_pick_height_is_below_the_highest_point_between_the_fingers(with_brick):
    task = with_brick()[0].scene.task
    palm_height_m = task.robot.gripper.palm_height_m
    # the fingers around the object, the palm above it
    assert 0.005 < 0.1 - task.pick_height_m(0.1, CENTER) < palm_height_m
    # neither the tool nor the fingertips reach the floor of the tray
    assert task.pick_height_m(0.0, CENTER) + task.robot.gripper.tip_height_m(0.02) > FLOOR_Z_M
    assert task.window_m(None) == pytest.approx(task.robot.gripper.half_width_m, abs=4e-3)


def test_without_a_feasible_grasp_the_expert_picks_the_highest_object(make, tmp_path):
    (tmp_path / "slab").mkdir()
    write_obj(tmp_path / "slab" / "mesh.obj", [box_mesh((0.11, 0.1, 0.05))])
    env = make(object_set="graspnet", asset_root=str(tmp_path), num_objects=1, expert=True)
    state = env.reset()
    (slab,) = env.scene.task.objects
    x, y = state["expert_action"][1:3].tolist()
    assert math.dist((x, y), slab.position[:2]) < 0.03
    assert state["expert_action"][0] == PICK


@pytest.mark.slow
@pytest.mark.parametrize("config", [{"action_sequence": "pxyzrrr"}, {"object_set": "household"}])
def test_expert_over_200_episodes(make, config):
    env = make(expert=True, **config)
    solved = sum(bool(play(env, env.reset())["success"]) for _ in range(200))
    assert solved >= 0.85 * 200
