import logging
import warnings

import gymnasium
import numpy as np
import pytest
import torchrl.envs
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.passive_env_checker import env_render_passive_checker

import ba_torchrl
from ba_torchrl.core.errors import ConfigError, SimulationError
from ba_torchrl.envs import gym
from ba_torchrl.envs.registration import gym_id
from ba_torchrl.tasks.base import TASKS as REGISTRY
from tests.specs import slow_except

TASKS = slow_except(
    ba_torchrl.list_tasks(),
    ["close_loop/drawer_opening", "open_loop/covid_test", "ramp/block_stacking"],
)
PICKING = "BulletArm/CloseLoopBlockPicking-v0"
NOTHING = np.zeros(5, dtype=np.float32)


@pytest.fixture
def make():
    """Make environments, by default small and seeded, and close them."""
    made = []

    def make(gym_id=PICKING, **config):
        made.append(gymnasium.make(gym_id, **{"obs_size": 16, "seed": 0, **config}))
        return made[-1]

    yield make
    for env in made:
        env.close()


# -- every task ------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_the_environment_checker_passes(make, task):
    env = make(gym_id(task), expert=True, render_mode="rgb_array", max_steps=3).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # open-loop actions are metres and radians
        warnings.filterwarnings("ignore", message=".*symmetric and normalized")
        # Rendering is checked below: this check would open a window for the mode "human".
        check_env(env, skip_render_check=True)


@pytest.mark.parametrize("task", TASKS)
def test_stable_baselines_warns_about_nothing_but_the_range_of_depth(make, task):
    from stable_baselines3.common.env_checker import check_env

    size = {"obs_size": 36}  # the least that its own image encoder takes
    if REGISTRY[task].control == "open_loop":
        size["in_hand_size"] = 36
    env = make(gym_id(task), **size)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    said = [str(warning.message) for warning in caught]
    known = ("uint8", "[0, 255]", "range=[-1, 1]")
    assert all(any(part in text for part in known) for text in said), said


# -- spaces, configuration -------------------------------------------------------------------


def test_spaces_match_the_specs(make):
    env = make(action_sequence="pxyz", expert=True)
    assert set(env.observation_space) == {"depth", "holding"}
    depth, spec = env.observation_space["depth"], env.unwrapped.torchrl_env.observation_spec
    assert depth.shape == (1, 16, 16)
    assert depth.dtype == np.float32
    assert depth.low.tolist() == spec["depth"].low.tolist()
    assert depth.high.tolist() == spec["depth"].high.tolist()
    assert env.observation_space["holding"] == spaces.Box(0, 1, (1,), np.float32)
    assert env.action_space == spaces.Box(-1, 1, (4,), np.float32)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"robbot": "kuka"}, r"Did you mean 'robot'\?$"),
        ({"render_mode": "ascii"}, r"'ascii'\. Known: human, rgb_array"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*render_mode='ascii'")
def test_wrong_keywords_are_errors_with_the_allowed_ones(make, config, message):
    with pytest.raises(ConfigError, match=message):
        make(**config)


def test_options_of_other_libraries_have_no_effect_and_one_warning(make):
    env = make()
    with pytest.warns(UserWarning, match="'block' has no effect"):
        first, _ = env.reset(seed=0, options={"block": 1})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again, _ = env.reset(seed=0, options={"block": 1})
    np.testing.assert_array_equal(first["depth"], again["depth"])


# -- episodes --------------------------------------------------------------------------------


def episode(env, seed=None, steps=5):
    """Return the observations of an episode of fixed actions."""
    observations = [env.reset(seed=seed)[0]]
    for t in range(steps):
        observations.append(env.step(np.full(5, 0.3 - 0.1 * t, dtype=np.float32))[0])
    return observations


def same(first, second):
    return all(
        np.array_equal(a[key], b[key]) for a, b in zip(first, second, strict=True) for key in a
    )


def test_a_seed_fixes_an_episode_and_those_that_follow(make):
    env, other = make(seed=8), make(seed=9)
    first = [episode(env, seed=3), episode(env), episode(env)]
    second = [episode(other, seed=3), episode(other), episode(other)]
    again = [episode(env, seed=3), episode(env)]
    assert all(same(a, b) for a, b in zip(first, second, strict=True))
    assert all(same(a, b) for a, b in zip(first[:2], again, strict=True))
    assert not same(first[0], first[1])
    assert not same(first[0], episode(env, seed=4))


def test_episodes_are_those_of_torchrl(make):
    env = make(seed=5, expert=True)
    reference = ba_torchrl.make("close_loop/block_picking", obs_size=16, seed=5, expert=True)
    for seed in (None, 7):
        if seed is not None:
            reference.set_seed(seed, static_seed=True)
        state = reference.reset()
        observation, info = env.reset(seed=seed)
        for _ in range(3):
            assert np.array_equal(observation["depth"], state["depth"].numpy())
            assert np.array_equal(info["expert_action"], state["expert_action"].numpy())
            state = reference.step(state.set("action", state["expert_action"]))["next"]
            observation, *_, info = env.step(info["expert_action"])
    reference.close()


def test_the_expert_in_info_succeeds_and_success_terminates(make):
    env = make(expert=True)
    _, info = env.reset(seed=1)
    assert (info["success"], info["fault"], info["step_count"]) == (False, False, 0)
    for step in range(1, 16):
        observation, reward, terminated, truncated, info = env.step(info["expert_action"])
        assert info["step_count"] == step
        assert not truncated
        assert reward == float(info["success"]) == float(info["is_success"])
        assert terminated == info["success"]
        if terminated:
            break
    assert terminated
    assert observation["holding"].tolist() == [1]


def test_types_are_numpy_or_python_types(make):
    env = make(expert=True).unwrapped
    observation, info = env.reset(seed=0)
    assert {type(value) for value in observation.values()} == {np.ndarray}
    assert type(info["expert_action"]) is np.ndarray
    observation, reward, terminated, truncated, info = env.step(NOTHING)
    assert [type(x) for x in (reward, terminated, truncated)] == [float, bool, bool]
    assert {type(value) for value in info.values()} == {np.ndarray, np.int64}
    assert observation in env.observation_space
    assert "expert_action" not in make().reset()[1]


@pytest.mark.parametrize("variant", ["State", "StateDense"])
def test_a_state_is_one_box_that_torchrl_and_normalisers_take(variant):
    name = gym_id("close_loop/block_reaching", variant)
    env = gymnasium.make(name, seed=0, expert=True, max_steps=30)
    poses = gymnasium.make(gym_id("close_loop/block_reaching"), obs_type="vec", seed=0)
    (state, info), (expected, _) = env.reset(seed=1), poses.reset(seed=1)
    assert env.observation_space == spaces.flatten_space(poses.observation_space)
    assert env.unwrapped.observation_space == env.observation_space  # where Tianshou reads it
    assert state in env.observation_space
    assert state.tolist() == [*expected["holding"], *expected["observation"]]
    assert (env.spec.max_episode_steps, env._max_episode_steps) == (30, 30)
    assert (0 < env.step(info["expert_action"])[1] < 1) == (variant == "StateDense")
    env.close()
    poses.close()
    learner = torchrl.envs.GymEnv(name)
    torchrl.envs.check_env_specs(learner)
    assert set(learner.observation_spec.keys()) == {"observation"}
    learner.close()


def test_the_step_limit_is_that_of_the_environment(make):
    assert make(max_steps=70).spec.max_episode_steps == 70
    assert make(max_episode_steps=7).spec.max_episode_steps == 7
    again = gymnasium.make(make(gym_id("close_loop/block_reaching", "State"), max_steps=9).spec)
    assert (again.spec.max_episode_steps, again._max_episode_steps) == (9, 9)
    again.close()


def test_torchrl_registers_all_of_info():
    env = torchrl.envs.GymEnv(PICKING, obs_size=16, seed=0, expert=True)
    try:
        rollout = env.auto_register_info_dict().rollout(2)
    finally:
        env.close()
    assert rollout["next", "step_count"].tolist() == [1, 2]
    assert rollout["expert_action"].shape == (2, 5)
    assert {"success", "is_grasped", "is_out_of_reach"} <= set(rollout["next"].keys())


def test_the_step_limit_truncates(make):
    env = make(max_steps=2)
    env.reset()
    assert env.step(NOTHING)[2:4] == (False, False)
    assert env.step(NOTHING)[2:4] == (False, True)
    shorter = make(max_steps=2, max_episode_steps=1)
    shorter.reset()
    assert shorter.step(NOTHING)[2:4] == (False, True)


def test_a_simulator_fault_truncates_and_is_in_info(make, monkeypatch, caplog):
    def fail(*_):
        raise SimulationError("the solver exploded")

    env = make(expert=True)
    _, expected = env.reset()
    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(env.unwrapped.torchrl_env.scene.controller, "move_to", fail)
        _, reward, terminated, truncated, info = env.step(NOTHING)
    assert (reward, terminated, truncated, info["fault"]) == (0.0, False, True, True)
    assert {key: type(value) for key, value in info.items()} == {
        key: type(value) for key, value in expected.items()
    }
    assert not info["is_grasped"]
    env.reset()
    assert not env.step(NOTHING)[-1]["fault"]


# -- rendering, closing --------------------------------------------------------------------------


def test_rgb_array_returns_images(make):
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    env_render_passive_checker(env.unwrapped)
    before = env.render()
    env.step(np.array([-1, 1, 1, -1, 0], dtype=np.float32))
    assert before.dtype == np.uint8
    assert before.ndim == 3
    assert before.shape[2] == 3
    assert (env.render() != before).any()
    assert env.metadata["render_fps"] > 0


def test_render_without_a_mode_warns(make):
    env = make()
    env.reset()
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert env.unwrapped.render() is None


def test_human_opens_a_window(monkeypatch):
    asked = []
    real = gym.resolve_env

    def without_window(task, config, **options):
        asked.append(config.pop("render", False))
        return real(task, config, **options)

    monkeypatch.setattr(gym, "resolve_env", without_window)
    for mode in ("human", "rgb_array", None):
        env = gym.GymEnv("close_loop/block_picking", render_mode=mode, obs_size=16)
        env.reset()
        if mode == "human":
            assert env.render() is None
        env.close()
    assert asked == [True, False, False]


def test_closing_closes_the_simulator_and_may_be_repeated(make):
    env = make()
    env.reset()
    env.close()
    assert env.unwrapped.torchrl_env.is_closed
    env.close()


# -- vectors, training -----------------------------------------------------------------------


def test_vectors_give_the_episodes_of_single_environments(make):
    single = [episode(make(), seed=seed, steps=2) for seed in (4, 5)]
    actions = [np.full((2, 5), 0.3 - 0.1 * t, dtype=np.float32) for t in range(2)]
    options = {"sync": {}, "async": {"vector_kwargs": {"context": "fork"}}}
    for mode, kwargs in options.items():
        env = gymnasium.make_vec(
            PICKING, 2, vectorization_mode=mode, obs_size=16, expert=True, **kwargs
        )
        try:
            observation, info = env.reset(seed=[4, 5])
            assert info["expert_action"].shape == (2, 5)
            observations = [observation]
            for action in actions:
                observation, _, _, _, info = env.step(action)
                observations.append({key: value.copy() for key, value in observation.items()})
            assert info["step_count"].tolist() == [2, 2]
            flags = ("success", "is_success", "fault", "is_grasped", "is_out_of_reach")
            assert {info[key].dtype for key in flags} == {np.dtype(bool)}
        finally:
            env.close()
        for index in range(2):
            row = [{key: value[index] for key, value in each.items()} for each in observations]
            assert same(single[index], row), f"{mode}, environment {index}"
