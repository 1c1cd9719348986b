"""The experts of the packing tasks."""

import numpy as np
import pytest
import torch

from tests.tasks.packing.scenes import BIN, BOTTLES, BOXES, follow

VARIANTS = {
    "3D": {},
    "6D": {"action_sequence": "pxyzrrr"},
    "2D": {"random_orientation": False, "action_sequence": "pxy"},
}
TASKS = [
    (BIN, {}, 16, "3D"),
    (BIN, {"num_objects": 4}, 8, "6D"),
    (BIN, {}, 16, "2D"),
    (BOTTLES, {}, 12, "3D"),
    (BOTTLES, {}, 12, "6D"),
    (BOTTLES, {}, 12, "2D"),
    (BOXES, {}, 36, "3D"),
    (BOXES, {"num_objects": 6}, 12, "6D"),
    (BOXES, {"num_objects": 6}, 12, "2D"),  # every second layer needs the yaw
]


def check_expert(make_env, task, config, optimum, variant, episodes, least):
    env = make_env(task, **{"obs_size": 128, **config, **VARIANTS[variant]})
    lengths = []
    for _ in range(episodes):
        seen = follow(env, env.reset())
        if seen[-1]["success"]:
            lengths.append(len(seen))
    assert len(lengths) >= least * episodes
    assert np.median(lengths) == optimum
    assert env.faults == 0


@pytest.mark.parametrize(("task", "config", "optimum", "variant"), TASKS)
def test_the_expert_takes_the_fewest_steps(make_env, task, config, optimum, variant):
    check_expert(make_env, task, config, optimum, variant, episodes=4, least=1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("task", "config", "optimum", "variant"), TASKS)
def test_the_expert_over_200_episodes(make_env, task, config, optimum, variant):
    check_expert(make_env, task, config, optimum, variant, episodes=200, least=0.99)


@pytest.mark.parametrize("robot", ["panda", "ur5", "ur5_robotiq"])
@pytest.mark.parametrize(
    ("task", "config"), [(BIN, {"num_objects": 3}), (BOTTLES, {}), (BOXES, {})]
)
def test_the_expert_succeeds_with_other_robots(make_env, task, config, robot):
    env = make_env(task, obs_size=128, robot=robot, **config)
    assert follow(env, env.reset())[-1]["success"]


@pytest.mark.parametrize(("task", "least"), [(BIN, 0.7), (BOXES, 0.9)])
def test_the_expert_recovers_from_noisy_actions(make_env, task, least):
    env = make_env(task, obs_size=128, num_objects=6, max_steps=60)
    space = env.action_spec.space
    outcomes = []
    for episode in range(14):
        state = env.reset(seed=episode)
        rng = np.random.default_rng(episode)
        for _ in range(6):
            action = state["expert_action"].clone()
            action[1:3] += torch.from_numpy(rng.uniform(-0.03, 0.03, 2).astype(np.float32))
            action[3] += rng.uniform(-0.4, 0.4)
            action = torch.maximum(torch.minimum(action, space.high), space.low)
            state = env.step(state.clone().set("action", action))["next"]
            if state["done"]:
                break
        else:
            outcomes.append(bool(follow(env, state)[-1]["success"]))
    # an object that lies against the outside of the bin leaves no clearance for a finger
    assert len(outcomes) >= 9
    assert np.mean(outcomes) >= least, outcomes
