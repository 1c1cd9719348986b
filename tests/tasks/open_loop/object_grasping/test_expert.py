"""The expert of open-loop object grasping."""

import math

import pytest
import torch

from ba_torchrl.actions import PICK
from ba_torchrl.sim.meshes import box_mesh, write_obj
from tests.tasks.open_loop.object_grasping.heaps import NO_OP, play


def successes(env, episodes, policy=None):
    count = 0
    for _ in range(episodes):
        state = env.reset()
        action = None if policy is None else policy()
        count += bool(play(env, state, action)["success"])
    return count


def test_the_expert_selects_another_grasp_after_failures(make):
    env = make(expert=True)
    first = env.reset()["expert_action"]
    play(env, env.reset(), NO_OP)
    second = env.reset()["expert_action"]
    assert math.dist(first[1:3].tolist(), second[1:3].tolist()) > 0.03


def test_the_expert_succeeds_more_often_than_random_picks(make):
    env = make(expert=True)
    expert = successes(env, 40)
    rng = torch.Generator().manual_seed(0)
    low, high = env.action_spec.space.low, env.action_spec.space.high

    def anywhere():
        action = low + torch.rand(4, generator=rng) * (high - low)
        action[0] = PICK
        return action

    chance = successes(env, 40, anywhere)
    assert expert >= 34
    assert chance <= 20


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
@pytest.mark.parametrize(
    ("config", "least"),
    [
        ({"action_sequence": "pxyzrrr"}, 0.85),
        ({"object_set": "household"}, 0.85),
    ],
    ids=["6D", "household"],
)
def test_expert_over_200_episodes(make, config, least):
    assert successes(make(expert=True, **config), 200) >= least * 200
