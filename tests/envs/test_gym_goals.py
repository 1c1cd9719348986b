"""Goals as vectors, and the expert as a policy, in the interfaces of other libraries."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from ba_torchrl.core.errors import ConfigError, SimulationError
from ba_torchrl.envs.gym import ExpertPolicy
from ba_torchrl.envs.registration import gym_id, register_task, variants_of
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.goals import Goal

PUSHING = gym_id("close_loop/block_pushing", "Goal")


@pytest.fixture
def make():
    made = []

    def make(name, **config):
        made.append(gymnasium.make(name, **{"seed": 0, **config}))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.mark.parametrize("task", [task for task in TASKS if TASKS[task].goal_vectors is not None])
def test_rewards_and_ends_are_those_of_the_goals(make, task):
    env = make(gym_id(task, "Goal"), expert=True, max_steps=20)
    plain = make(gym_id(task, "State"), max_steps=20)
    compute = [getattr(env.unwrapped, f"compute_{what}") for what in ("reward", "terminated")]
    expert, steps, successes = ExpertPolicy(env), [], 0
    rng = np.random.default_rng(0)
    for seed in range(4):
        (observation, info), _ = env.reset(seed=seed), plain.reset(seed=seed)
        is_over = False
        while not is_over:
            goals = [observation[key] for key in ("achieved_goal", "desired_goal")]
            assert compute[0](*goals, info) == 0
            action = expert.predict(observation)[0]
            if not seed:  # random actions do not reach the goal
                action = rng.uniform(-1, 1, 5)
            observation, *result, info = env.step(action)
            assert result == list(plain.step(action)[1:4])
            assert observation in env.observation_space
            goals = [observation[key] for key in ("achieved_goal", "desired_goal")]
            assert compute[0](*goals, info) == result[0]
            assert compute[1](*goals, info) == result[1]
            steps.append((*goals, *result[:2]))
            is_over = any(result[1:])
        successes += info["success"]
    assert successes == 3
    achieved, desired, rewards, ends = map(np.array, zip(*steps, strict=True))
    assert compute[0](achieved[None], desired[None], [{}])[0].tolist() == rewards.tolist()
    assert compute[1](achieved, desired, {}).tolist() == ends.tolist()
    assert compute[0](achieved, achieved, {}).all()
    assert not env.unwrapped.compute_truncated(achieved, desired, {}).any()


def test_the_goal_is_not_in_the_observation(make):
    env, plain = make(PUSHING), make(gym_id("close_loop/block_pushing", "State"))
    observation, state = env.reset(seed=1)[0], plain.reset(seed=1)[0]
    assert observation["observation"].tolist() == state[:-4].tolist()
    goal = env.unwrapped.torchrl_env.scene.task.goal
    assert observation["desired_goal"].tolist() == np.float32(goal.position[:2]).tolist()


def test_a_fault_and_an_invalid_scene_achieve_nothing(make, monkeypatch):
    env = make(gym_id("close_loop/block_reaching", "Goal"))
    before = env.reset(seed=0)[0]
    inner = env.unwrapped.torchrl_env
    block = inner.scene.task.block
    with monkeypatch.context() as patch:
        # the tool is in the block, which is no longer in the workspace
        tool = inner.scene.robot.tool_pose()[0]
        patch.setattr(inner.scene.task, "is_valid", lambda: False)
        block.place(tool)
        after, reward, terminated, _, info = env.step(np.zeros(5, np.float32))
    assert (reward, terminated, info["success"]) == (0, True, False)
    assert not env.unwrapped.compute_terminated(after["achieved_goal"], after["desired_goal"], info)
    before = env.reset(seed=0)[0]

    def fail(*_):
        raise SimulationError("the solver exploded")

    monkeypatch.setattr(inner.scene.controller, "move_to", fail)
    after, *_, info = env.step(np.zeros(5, np.float32))
    assert info["fault"]
    assert all((after[key] == before[key]).all() for key in before)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"reward": "dense"}, r"reward='dense': ids with goals have reward='sparse'"),
        ({"obs_type": "pixel"}, r"obs_type='pixel': ids with goals have obs_type='vec'"),
        (
            {"task": "close_loop/drawer_opening"},
            r"drawer_opening has no goals .* Known: close_loop",
        ),
    ],
)
def test_what_has_no_goals_is_refused(make, config, message):
    with pytest.raises(ConfigError, match=message):
        make(PUSHING, **config)


def test_goals_of_another_length_are_refused(make):
    compute = make(PUSHING).unwrapped.compute_reward
    with pytest.raises(
        ValueError, match=r"desired_goal \[\.\.\., 2\] is needed \(block x, block y\)"
    ):
        compute(np.zeros((3, 2)), np.zeros((3, 3)), {})


def test_hindsight_replay_of_stable_baselines_learns_from_the_goals(make):
    from stable_baselines3 import SAC, HerReplayBuffer

    agent = SAC(
        "MultiInputPolicy",
        make(PUSHING, max_steps=8),
        replay_buffer_class=HerReplayBuffer,
        learning_starts=20,
        batch_size=64,
        policy_kwargs={"net_arch": [8]},
        seed=0,
    ).learn(24)
    found = agent.replay_buffer.sample(256)
    is_own = (found.observations["desired_goal"] == found.next_observations["desired_goal"]).all(-1)
    assert is_own.all()
    assert 0 < found.rewards.mean() < 1


def test_a_task_of_ones_own_gets_goals_by_an_attribute(monkeypatch):
    task = type("Mine", (TASKS["close_loop/block_reaching"],), {"goal_vectors": None})
    monkeypatch.setitem(TASKS._entries, "mine/reach", task)
    monkeypatch.setitem(TASKS._modules, "mine/reach", TASKS._modules["close_loop/block_reaching"])
    assert "Goal" not in variants_of("mine/reach")
    task.goal_vectors = Goal(("gripper",), lambda task: (1,), lambda task: (1,))
    assert "Goal" in variants_of("mine/reach")
    monkeypatch.setattr(gymnasium.envs.registration, "registry", {})
    register_task("mine/reach")
    env = gymnasium.make(gym_id("mine/reach", "Goal"))
    assert env.reset(seed=0)[0]["achieved_goal"].tolist() == [1]
    env.close()


def test_normalisers_take_flags(make):
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    name = gym_id("close_loop/block_reaching")
    vector = VecNormalize(DummyVecEnv([lambda: make(name, obs_type="vec")]))
    observation = vector.reset()
    assert {key: values.shape for key, values in observation.items()} == {
        "holding": (1, 1),
        "observation": (1, 9),
    }


# -- the expert ------------------------------------------------------------------------------


def test_the_expert_is_a_policy_of_stable_baselines(make):
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.policies import BasePolicy
    from stable_baselines3.common.vec_env import DummyVecEnv

    name = gym_id("close_loop/block_reaching", "State")
    vector = DummyVecEnv([lambda: make(name, expert=True)] * 2)
    for env in (vector, make(name, expert=True)):
        expert = ExpertPolicy(env)
        assert isinstance(expert, BasePolicy)  # which DAgger of imitation needs
        assert evaluate_policy(expert, env, n_eval_episodes=3, warn=False)[0] == 1


def test_the_expert_of_a_vector_acts_in_each_environment(make):
    name = gym_id("close_loop/block_reaching", "State")
    env = gymnasium.make_vec(name, 2, vectorization_mode="sync", expert=True)
    observation, info = env.reset(seed=[0, 1])
    expert = ExpertPolicy(env)
    for _ in range(3):
        action, state = expert(observation, None, None)
        assert action.tolist() == info["expert_action"].tolist()
        assert state is None
        observation, *_, info = env.step(action)
    assert (expert.observation_space, expert.action_space) == (
        env.single_observation_space,
        spaces.Box(-1, 1, (5,), np.float32),
    )
    env.close()
    single = make(gym_id("close_loop/block_reaching"), obs_size=16, expert=True)
    observation, info = single.reset(seed=0)
    batch = {key: values[None] for key, values in observation.items()}
    expert = ExpertPolicy(single)
    assert expert.predict(batch)[0].tolist() == [expert.predict(observation)[0].tolist()]
    assert expert.predict(observation)[0].tolist() == info["expert_action"].tolist()


def test_an_expert_that_was_not_asked_for_is_an_error(make):
    env = make(gym_id("close_loop/block_reaching", "State"))
    observation, _ = env.reset()
    with pytest.raises(ConfigError, match=r"give expert=True to gymnasium\.make, and reset"):
        ExpertPolicy(env).predict(observation)
