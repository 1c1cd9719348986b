"""Dense rewards: the progress of the tasks, and its difference, which keeps optimal policies."""

import copy
import math
import re

import gymnasium
import numpy as np
import pytest
import torch

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.demonstrations.time_reversal import make_deconstruction_env
from ba_torchrl.tasks.base import TASKS, Task
from ba_torchrl.tasks.close_loop.block_picking import BlockPicking
from ba_torchrl.training.config import ExperimentConfig
from tests.specs import slow_except

REACHING, PICKING = "close_loop/block_reaching", "close_loop/block_picking"
DENSE = [name for name in TASKS if TASKS[name].progress is not Task.progress]
SEEDS = range(3)
SETTINGS = {"seed": 0, "expert": True}


def play(env, seed, *, expert):
    """Return the first state and the steps [T] of an episode of the expert or of random actions."""
    state, rng = env.reset(seed=seed), np.random.default_rng(seed)
    low, high = env.action_spec.space.low, env.action_spec.space.high
    start, steps = state, []
    while not steps or not state[keys.DONE]:
        share = torch.from_numpy(rng.random(len(low), dtype=np.float32))
        action = state[keys.EXPERT_ACTION] if expert else low + (high - low) * share
        state = env.step(state.clone().set(keys.ACTION, action))[keys.NEXT]
        steps.append(state)
    return start, torch.stack(steps)


def rewards(steps):
    return steps[keys.REWARD].flatten().tolist()


@pytest.mark.parametrize(
    "task",
    slow_except(
        DENSE,
        [
            *(name for name in DENSE if name.startswith("close_loop/")),
            "open_loop/house_building_3",
            "ramp/improvise_house_building_2",
        ],
    ),
)
def test_progress_rises_to_success_along_the_experts_episodes(make, task):
    size = {"obs_type": "vec"} if task.startswith("close_loop") else {"obs_size": 128}
    env, other = (make(task, reward="dense", expert=expert, **size) for expert in (True, False))
    thirds, random_means = [], []
    for seed in SEEDS[:2]:
        env.reset(seed=seed)
        first = env.scene.task.progress()
        _, steps = play(env, seed, expert=True)
        seen, success = rewards(steps), steps[keys.SUCCESS].flatten().tolist()
        assert success[-1]
        assert [value == 1 for value in seen] == success
        assert all(0 <= value < 1 for value in [first, *seen[:-1]])
        assert seen[-2] > first + 0.2
        if task != "close_loop/object_grasping":  # whose expert grasps again after a slip
            assert min(np.diff([first, *seen])) > -0.03
        thirds.append([np.mean(part) for part in np.array_split([first, *seen[:-1]], 3)])
        _, steps = play(other, seed, expert=False)  # an expert plans for long in such scenes
        assert all(0 <= value < 1 for value in rewards(steps))
        random_means.append(np.mean(rewards(steps)))
    low, middle, high = np.mean(thirds, axis=0)
    assert low + 0.05 < middle < high - 0.05
    assert np.mean(random_means) < middle


def test_reaching_rewards_the_distance_to_the_region_of_success(make):
    env = make(REACHING, reward="dense", obs_type="vec", expert=False)
    env.reset()
    scene = env.scene
    scene.task.block.place((0.45, 0.0, 0.025))
    for distance_m in (0.02, 0.08, 0.18):
        scene.controller.reset(((0.45, 0.0, 0.025 + distance_m), 0.0))
        x, y, z = scene.robot.tool_pose()[0]
        from_goal = max(math.hypot(x - 0.45, y, z - 0.025) - 0.03, 0.0)
        yaw, opening = scene.robot.tool_pose()[1], scene.robot.opening()
        from_goal += 0.03 * abs(yaw) + 0.03 * (1 - opening)
        expected = 0.9 * (1 - math.tanh(from_goal / 0.15))
        assert scene.task.progress() == pytest.approx(expected)
    scene.controller.grip(0.0)
    scene.controller.move_to((0.45, 0.0, 0.205), 0.5)
    assert scene.task.progress() == pytest.approx(0.9 * (1 - math.tanh(0.195 / 0.15)), abs=5e-3)


def test_picking_counts_reach_grasp_and_lift_as_a_third_each(make):
    env = make(PICKING, reward="dense", obs_type="vec", expert=False, random_orientation=False)
    env.reset()
    scene, task = env.scene, env.scene.task
    task.block.place((0.45, 0.0, 0.025))
    scene.controller.reset(((0.45, 0.0, 0.125), 0.0))
    assert task.progress() == pytest.approx(0.3 * (1 - math.tanh(0.1 / 0.15)), abs=1e-3)
    scene.controller.move_to((0.45, 0.0, 0.025), 0.0)
    assert task.progress() == pytest.approx(0.3, abs=0.01)
    scene.controller.grip(0.0)
    scene.controller.move_to((0.45, 0.0, 0.08), 0.0)
    assert task.progress() == pytest.approx(0.6 + 0.3 * 0.07 / 0.14, abs=0.01)
    scene.controller.grip(1.0)  # a hand at that height without the block has no share of the lift
    assert task.progress() < 0.3


def test_a_structure_counts_its_filled_slots_and_the_way_of_one_more_piece(make):
    env = make("open_loop/house_building_2", reward="dense", obs_size=32, expert=False)
    env.reset()
    task = env.scene.task
    kinds = {piece.kind: body for body, piece in task.structure.pieces.items()}
    cubes = [body for body, piece in task.structure.pieces.items() if piece.kind == "cube"]
    most_m = task.structure.blueprint.slots[2].span.most_m

    def progress(gap_m):
        kinds["roof"].place((0.35, 0.0, 0.015))
        for x, body in zip((0.4, 0.4 + gap_m), cubes, strict=True):
            body.place((x, 0.1, 0.015))
        env.scene.world.step(2)
        return task.progress()

    # one cube stands on the ground; the other, 4 cm too far off, is a part of half the way
    far = progress(most_m + 0.04)
    assert far == pytest.approx(0.9 * (1 + 0.5 * (1 - math.tanh(0.04 / 0.15))) / 3, abs=2e-3)
    # both stand, and the roof, on the ground, is 3 cm too low and aside of their centre
    x = 0.4 + (most_m - 0.005) / 2 - 0.35
    off = math.hypot(x, 0.1, 0.03)
    expected = 0.9 * (2 + 0.5 * (1 - math.tanh(off / 0.15))) / 3
    assert progress(most_m - 0.005) == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("expert", [True, False])
@pytest.mark.parametrize("task", [PICKING, "close_loop/block_pushing"])
def test_the_discounted_differences_add_up_to_those_of_the_ends(make, task, expert):
    settings = {"obs_type": "vec", "max_steps": 20}
    env = make(task, reward="difference", reward_discount=0.9, **settings)
    dense = make(task, reward="dense", **settings)
    for seed in SEEDS:
        dense.reset(seed=seed)
        first = dense.scene.task.progress()
        _, steps = play(dense, seed, expert=expert)
        _, shaped = play(env, seed, expert=expert)
        terminated = bool(shaped[keys.TERMINATED][-1])
        assert terminated or bool(shaped[keys.TRUNCATED][-1])
        last = 0.0 if terminated else rewards(steps)[-1]
        added = np.array(rewards(shaped)) - shaped[keys.SUCCESS].flatten().float().numpy()
        total = sum(0.9**t * value for t, value in enumerate(added))
        assert total == pytest.approx(0.9 ** len(added) * last - first, abs=1e-5)
        assert any(abs(value) > 1e-3 for value in added)


def test_an_object_that_leaves_the_workspace_costs_the_progress(make):
    env = make(PICKING, reward="difference", obs_type="vec", expert=False)
    before = (env.reset(), env.scene.task.progress())[1]
    env.scene.task.block.place((0.45, 0.16, 0.025))
    outcome = env._step(env.full_action_spec.zero())
    assert outcome[keys.TERMINATED]
    assert outcome[keys.REWARD].item() == pytest.approx(-before)


@pytest.mark.parametrize("task", ["close_loop/block_pulling", "open_loop/block_stacking"])
def test_the_reward_changes_nothing_else(make, task, monkeypatch):
    played = play(make(task, reward="difference"), 0, expert=True)[1]
    monkeypatch.setattr(TASKS[task], "progress", lambda task: pytest.fail("sparse measures none"))
    sparse = play(make(task), 0, expert=True)[1]
    assert (played.exclude(keys.REWARD) == sparse.exclude(keys.REWARD)).all()
    assert torch.equal(sparse[keys.REWARD], sparse[keys.SUCCESS].float())


def test_states_and_copies_keep_the_progress(make):
    env = make(PICKING, reward="difference", obs_type="vec")
    state = env.reset()
    for _ in range(3):
        state = env.step(state.set(keys.ACTION, state[keys.EXPERT_ACTION].clone()))[keys.NEXT]
    action = state.clone().set(keys.ACTION, state[keys.EXPERT_ACTION])
    saved, other = env.get_state(), copy.deepcopy(env)
    expected = env.step(action.clone())[keys.NEXT, keys.REWARD]
    assert expected.item() > 0.01
    env.step(env.reset(seed=7).set(keys.ACTION, torch.zeros(5)))
    env.reset(saved, set_state=True)
    assert env.step(action.clone())[keys.NEXT, keys.REWARD] == expected
    assert other.step(action.clone())[keys.NEXT, keys.REWARD] == expected
    other.close()


def test_vectors_and_gymnasium_have_the_same_reward(make):
    _, steps = play(make(PICKING, reward="dense", obs_type="vec"), 0, expert=True)
    settings = {"reward": "dense", "obs_type": "vec", "expert": True}
    envs = ba_torchrl.make_vector_env(PICKING, 2, seed=0, parallel=False, **settings)
    state = envs.reset()
    env = gymnasium.make("BulletArm/CloseLoopBlockPicking-v0", **settings)
    _, info = env.reset(seed=0)
    for expected in rewards(steps):
        state = envs.step(state.set(keys.ACTION, state[keys.EXPERT_ACTION].clone()))[keys.NEXT]
        _, reward, *_, info = env.step(info["expert_action"])
        assert state[keys.REWARD][0].item() == reward == expected
    envs.close()
    env.close()


def test_value_targets_continue_behind_a_success_with_dense_rewards_only(make):
    for reward, ends in (
        ("sparse", "terminated"),
        ("difference", "terminated"),
        ("dense", "truncated"),
    ):
        last = play(make(PICKING, reward=reward, obs_type="vec"), 0, expert=True)[1][-1]
        assert last[keys.SUCCESS]
        assert last[keys.DONE]
        assert [name for name in (keys.TERMINATED, keys.TRUNCATED) if last[name]] == [ends]
    env = make(PICKING, reward="dense", obs_type="vec", expert=False)
    env.reset()
    env.scene.task.block.place((0.45, 0.16, 0.025))
    outcome = env._step(env.full_action_spec.zero())
    assert outcome[keys.TERMINATED]
    assert not outcome[keys.TRUNCATED]


def test_a_fault_has_no_reward(make, monkeypatch):
    env = make(PICKING, reward="dense", obs_type="vec", expert=False)
    state = env.reset()
    monkeypatch.setattr(type(env), "_act", lambda _, scene, action: scene.world.close())
    state = env.step(state.set(keys.ACTION, torch.zeros(5)))[keys.NEXT]
    assert state[keys.FAULT]
    assert state[keys.REWARD] == 0


@pytest.mark.parametrize("at_reset", [True, False])
@pytest.mark.parametrize(
    ("progress", "message"),
    [
        (lambda _: 1.0, "must be a number in [0, 1), not 1.0"),
        (lambda _: -0.1, "must be a number in [0, 1), not -0.1"),
        (lambda _: math.nan, "must be a number in [0, 1), not nan"),
        (lambda _: None, "must be a number in [0, 1), not None"),
        (lambda _: torch.zeros(2), "must be a number in [0, 1), not tensor([0., 0.])"),
    ],
)
def test_a_progress_outside_its_range_is_no_fault_of_the_simulator(
    make, monkeypatch, progress, message, at_reset
):
    env = make(PICKING, reward="dense", obs_type="vec")
    state = None if at_reset else env.reset()
    monkeypatch.setattr(BlockPicking, "progress", progress)
    with pytest.raises(ConfigError, match=re.escape(f"{PICKING}: BlockPicking.progress {message}")):
        env.reset() if at_reset else env.step(state.set(keys.ACTION, torch.zeros(5)))
    assert env.faults == 0


@pytest.mark.parametrize("value", [torch.tensor(0.5), np.float32(0.5), np.array(0.5), 0])
def test_a_progress_of_any_kind_of_number_is_a_reward(make, monkeypatch, value):
    env = make(PICKING, reward="dense", obs_type="vec")
    state = env.reset()
    monkeypatch.setattr(BlockPicking, "progress", lambda _: value)
    state = env.step(state.set(keys.ACTION, torch.zeros(5)))[keys.NEXT]
    assert rewards(state) == [float(value)]


def test_reversed_episodes_have_the_sparse_reward_only():
    with pytest.raises(ConfigError, match=r"reward: 'dense' is not that of the reversed"):
        make_deconstruction_env("open_loop/house_building_2", reward="dense")


@pytest.mark.parametrize(
    ("env", "algorithm", "message"),
    [
        ({"reward": "difference", "reward_discount": 0.95}, {"gamma": 0.95}, None),
        (
            {"reward": "difference"},
            {"gamma": 0.95},
            r"env.reward_discount: 0.99 .* algorithm.gamma, 0.95",
        ),
        ({"reward": "dense"}, {"gamma": 0.95}, None),
        ({"reward": "dense"}, {"bootstrap_truncated": False}, "needs algorithm.bootstrap_trunc"),
    ],
)
def test_the_learner_values_what_the_rewards_assume(env, algorithm, message):
    values = {
        "task": PICKING,
        "env": {"obs_size": 64, **env},
        "algorithm": {"name": "sac", **algorithm},
        "network": {"name": "cnn"},
    }
    if message is None:
        ExperimentConfig.parse(values)
        return
    with pytest.raises(ConfigError, match=message):
        ExperimentConfig.parse(values)
