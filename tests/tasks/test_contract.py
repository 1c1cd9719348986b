"""Every task keeps the same promises; a new task is tested here without being named."""

import functools
import math
import pickle

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

import ba_torchrl
from ba_torchrl.sim.robots.base import ROBOTS

TASKS = ba_torchrl.list_tasks()
MEAN_STEPS = {"reaching": 3.0, "picking": 7.0, "pushing": 7.7, "pulling": 7.3}
"""Of the published planners (tests allow a tenth more)."""


@pytest.fixture(params=TASKS)
def task(request):
    return request.param


def make(task, **config):
    return ba_torchrl.make(task, **{"obs_size": 32, "seed": 0, **config})


def test_specs(task):
    env = make(task, expert=True, max_steps=2)
    check_env_specs(env, break_when_any_done="both", seed=0)
    env.close()


@pytest.mark.parametrize("parallel", [False, True], ids=["serial", "parallel"])
def test_specs_of_vectors(task, parallel):
    env = ba_torchrl.make_vector_env(
        task,
        2,
        parallel=parallel,
        start_method="fork",
        obs_size=32,
        seed=0,
        expert=True,
        max_steps=2,
    )
    check_env_specs(env, break_when_any_done="both", seed=0)
    env.close()


@pytest.mark.parametrize("robot", list(ROBOTS))
def test_reset_is_neither_solved_nor_invalid(task, robot):
    env = make(task, robot=robot)
    for _ in range(20):
        state = env.reset()
        assert not env.scene.task.is_goal()
        assert env.scene.task.is_valid()
        assert not state["done"]
        assert not state["success"]
        assert state["step_count"] == 0
    env.close()


def test_same_seed_same_pixels_other_seed_other_pixels(task):
    first, second = make(task), make(task)
    policy = lambda td: td.set("action", torch.tensor([0.3, -0.5, 0.7, -1.0, 0.2]))  # noqa: E731
    a, b = (env.rollout(4, policy) for env in (first, second))
    assert torch.equal(a["next", "pixels"], b["next", "pixels"])
    first.set_seed(0)
    assert torch.equal(first.rollout(4, policy)["next", "pixels"], a["next", "pixels"])
    assert not torch.equal(first.reset(seed=1)["pixels"], a["pixels"][0])
    for env in (first, second):
        env.close()


def test_successive_episodes_differ(task):
    env = make(task)
    assert not torch.equal(env.reset()["pixels"], env.reset()["pixels"])
    env.close()


def test_observations_never_alias_a_buffer(task):
    env = make(task)
    state = env.reset()
    kept, copy = state["pixels"], state["pixels"].clone()
    action = torch.full((5,), -0.8)
    following = env.step(state.set("action", action))["next"]
    kept_next, copy_next = following["pixels"], following["pixels"].clone()
    env.step(following.clone().set("action", -action))
    assert torch.equal(kept, copy)
    assert torch.equal(kept_next, copy_next)
    assert not torch.equal(copy, copy_next)
    env.close()


def test_random_actions_never_raise_and_stay_in_the_specs(task):
    env = make(task)
    for _ in range(2):
        rollout = env.rollout(50)
        assert env.observation_spec.is_in(rollout["next"].select(*env.observation_spec.keys())[-1])
    assert env.faults == 0
    env.close()


def test_extreme_actions_never_raise(task):
    env = make(task)
    rng = np.random.default_rng(0)
    policy = lambda td: td.set(  # noqa: E731
        "action", torch.from_numpy(rng.choice([-1.0, 1.0], 5).astype(np.float32))
    )
    for _ in range(3):
        env.rollout(50, policy)
    assert env.faults == 0
    env.close()


def test_the_constructor_can_be_pickled(task):
    factory = pickle.loads(pickle.dumps(functools.partial(ba_torchrl.make, task, obs_size=16)))
    env = factory()
    env.reset()
    env.close()


def test_step_limit_truncates_and_does_not_terminate(task):
    env = make(task, max_steps=3)
    stay = lambda td: td.set("action", torch.tensor([1.0, 0, 0, 0, 0]))  # noqa: E731
    rollout = env.rollout(10, stay)
    assert len(rollout) == 3
    last = rollout["next"][-1]
    assert last["truncated"]
    assert last["done"]
    assert not last["terminated"]
    assert rollout["next", "step_count"].flatten().tolist() == [1, 2, 3]
    env.close()


def play(env, episodes, policy=lambda td: td.set("action", td["expert_action"])):
    return [env.rollout(60, policy, auto_cast_to_device=False) for _ in range(episodes)]


def check_expert(env, task, episodes, least=0.99):
    played = play(env, episodes)
    env.close()
    successes = [len(episode) for episode in played if episode["next", "success"][-1]]
    assert len(successes) >= least * episodes
    expected = next((v for k, v in MEAN_STEPS.items() if task.endswith(f"block_{k}")), None)
    if expected is not None:
        assert np.mean(successes) <= 1.1 * expected
    for episode in played:
        following = episode["next"]
        assert torch.equal(following["reward"], following["success"].float())
        assert not following["done"][:-1].any()
        assert following["terminated"][-1] or following["truncated"][-1]


@pytest.mark.parametrize(
    "variant",
    [{}, {"random_orientation": False, "action_sequence": "pxyz"}, {"fast_mode": False}],
    ids=["random orientations", "fixed, without yaw", "simulated travel"],
)
def test_expert_succeeds(task, variant):
    check_expert(make(task, expert=True, **variant), task, episodes=40, least=0.97)


@pytest.mark.slow
@pytest.mark.parametrize(
    "variant",
    [
        {},
        {"random_orientation": False, "action_sequence": "pxyz"},
        {"random_orientation": False},
    ],
    ids=["random orientations", "fixed, without yaw", "fixed"],
)
def test_expert_succeeds_over_200_episodes(task, variant):
    check_expert(make(task, expert=True, **variant), task, episodes=200)


def test_expert_recovers_from_any_state(task):
    env = make(task, expert=True)
    outcomes = []
    for episode in range(40):
        state = env.reset(seed=episode)
        rng = np.random.default_rng(episode)
        for _ in range(8):  # somebody else acts first
            action = torch.from_numpy(rng.uniform(-1, 1, 5).astype(np.float32))
            state = env.step(state.set("action", action))["next"]
            if state["done"]:
                break
        else:
            while not state["done"]:
                state = env.step(state.set("action", state["expert_action"]))["next"]
            outcomes.append(bool(state["success"]))
    assert len(outcomes) >= 20
    assert np.mean(outcomes) >= 0.95
    env.close()


def test_asking_the_expert_changes_nothing(task):
    asked, alone = make(task, expert=True), make(task)
    policy = lambda td: td.set("action", torch.tensor([-1.0, 0.4, 0.4, -0.9, 0.1]))  # noqa: E731
    a, b = asked.rollout(6, policy), alone.rollout(6, policy)
    assert torch.equal(a["next", "pixels"], b["next", "pixels"])
    for _ in range(5):
        asked.scene.task.expert_command()
    assert all(math.isfinite(x) for x in asked.scene.robot.tool_pose()[0])
    asked.close()
    alone.close()


def test_partial_resets_in_a_vector(task):
    env = ba_torchrl.make_vector_env(task, 2, parallel=False, obs_size=16, seed=0)
    state = env.reset()
    state = env.step(state.set("action", torch.zeros(2, 5)))["next"]
    before = state["pixels"].clone()
    state["_reset"] = torch.tensor([[True], [False]])
    after = env.reset(state)
    assert after["step_count"].flatten().tolist() == [0, 1]
    assert torch.equal(after["pixels"][1], before[1])
    assert not torch.equal(after["pixels"][0], before[0])
    env.close()
