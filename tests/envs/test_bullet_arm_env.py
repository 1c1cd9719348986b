"""BulletArmEnv: the class of all environments, their actions, faults and episodes."""

import copy
import pickle
from functools import partial

import numpy as np
import pybullet
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, ParallelEnv, check_env_specs

import ba_torchrl
from ba_torchrl import BulletArmEnv
from ba_torchrl.core.errors import InvalidActionError
from ba_torchrl.demonstrations.time_reversal import make_deconstruction_env
from ba_torchrl.envs.checks import checked_action
from ba_torchrl.tasks.base import TASKS

TASK = "close_loop/block_picking"


@pytest.fixture
def env(make):
    return make(TASK, obs_size=16, seed=0)


@pytest.mark.parametrize("task", [TASK, "open_loop/block_stacking"])
def test_the_class_makes_an_environment_of_the_tasks_control(task):
    envs = [
        make(task, obs_size=16, seed=3) for make in (BulletArmEnv, ba_torchrl.make, BulletArmEnv)
    ]
    envs[2] = copy.deepcopy(envs[2])
    assert {type(env) for env in envs} == {type(envs[0])} != {BulletArmEnv}
    starts = [env.reset() for env in envs]
    assert all((start == starts[0]).all() for start in starts)
    assert all(isinstance(env, BulletArmEnv) and isinstance(env, EnvBase) for env in envs)
    check_env_specs(envs[0], break_when_any_done="both")
    for env in envs:
        env.close()


def test_an_environment_of_another_constructor_is_one_of_the_class():
    env = make_deconstruction_env("open_loop/block_stacking", obs_size=16, num_objects=2)
    assert isinstance(env, BulletArmEnv)
    with pytest.raises(TypeError, match="call BulletArmEnv"):
        type(env)("open_loop/block_stacking")
    env.close()


def test_available_envs_lists_the_tasks_of_plugins_too(env, monkeypatch):
    assert BulletArmEnv.available_envs == env.available_envs == ba_torchrl.list_tasks()
    monkeypatch.setattr(TASKS, "_entries", {**TASKS._entries, "mine/task": TASKS[TASK]})
    assert set(BulletArmEnv.available_envs) - set(ba_torchrl.list_tasks()) == set()
    assert "mine/task" in BulletArmEnv.available_envs


def test_the_class_is_a_constructor_for_processes_of_torchrl():
    kwargs = [{"task": TASK, "obs_size": 16, "seed": seed} for seed in (0, 1)]
    vector = ParallelEnv(2, BulletArmEnv, create_env_kwargs=kwargs, mp_start_method="fork")
    made = pickle.loads(pickle.dumps(partial(BulletArmEnv, **kwargs[1])))()
    try:
        assert torch.equal(vector.reset()["depth"][1], made.reset()["depth"])
    finally:
        vector.close()
        made.close()


def test_the_device_is_that_of_specifications_and_outputs():
    env = BulletArmEnv(TASK, obs_size=16, device="meta")  # which has no values
    state = env.reset()
    assert {str(env.device), str(state.device), state["depth"].device.type} == {"meta"}
    assert env.action_spec.device.type == env.observation_spec["depth"].device.type == "meta"
    env.close()
    vector = ba_torchrl.make_vector_env(TASK, 2, parallel=False, obs_size=16, device="cpu")
    assert vector.reset().device == vector.device == torch.device("cpu")
    vector.close()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("task", [TASK, "open_loop/block_stacking"])
def test_an_environment_whose_tensors_are_on_a_gpu(task):
    first, second = (BulletArmEnv(task, seed=0, device=name) for name in ("cuda", "cpu"))
    check_env_specs(first)
    first.set_seed(0)
    other = second.reset().to("cuda")
    state = first.reset()
    for _ in range(2):
        action = first.action_spec.rand()
        state = first.step(state.set("action", action))["next"]
        other = second.step(other.cpu().set("action", action.cpu()))["next"].to("cuda")
        assert state.device.type == "cuda"
        assert all(torch.equal(state[key], other[key]) for key in other.keys())  # noqa: SIM118
    assert len(first.get_position()["actions"][0]) == 2
    kept = first.get_state()
    assert first.reset(kept, set_state=True).device.type == "cuda"
    vector = ba_torchrl.make_vector_env(task, 2, parallel=False, device="cuda")
    check_env_specs(vector)
    vector.close()
    first.close()
    second.close()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.full((5,), float("nan")), "not finite"),
        (torch.tensor([0, 0, float("inf"), 0, 0]), "not finite"),
        (torch.zeros(4), r"shape \(5,\)"),
        (torch.zeros(5, dtype=torch.int64), "float32"),
    ],
)
def test_bad_actions_raise_before_anything_moves(env, action, message):
    state = env.reset()
    before = env.scene.world.steps
    with pytest.raises(InvalidActionError, match=message):
        env._step(state.clone().set("action", action))
    assert env.scene.world.steps == before
    assert env.step(state.set("action", torch.zeros(5)))["next", "step_count"] == 1


def test_a_missing_action_is_an_error(env):
    with pytest.raises(InvalidActionError, match="'action'"):
        env._step(env.reset())


class OnDevice(torch.Tensor):
    """A tensor that NumPy cannot read, as on a GPU."""

    def cpu(self):
        return self.as_subclass(torch.Tensor)

    def numpy(self):
        raise TypeError("can't convert a tensor of a device to numpy")


def test_an_action_may_be_on_another_device():
    action = torch.tensor([0.5, 0.0, -0.5]).as_subclass(OnDevice)
    assert checked_action(action, "task", "pxy").tolist() == [0.5, 0.0, -0.5]


def test_collectors_reset_each_environment_on_its_own():
    env = ba_torchrl.make_vector_env(TASK, 3, parallel=False, obs_size=16, seed=0, max_steps=7)
    collector = Collector(env, frames_per_batch=60, total_frames=60)
    (data,) = list(collector)
    collector.shutdown()
    assert data.shape == (3, 20)
    for row in data:
        counts = row["next", "step_count"].flatten().tolist()
        starts = row["step_count"].flatten().tolist()
        done = row["next", "done"].flatten().tolist()
        for t in range(19):
            assert starts[t + 1] == (0 if done[t] else counts[t])
            if not done[t]:
                assert torch.equal(row["depth"][t + 1], row["next", "depth"][t])
        assert max(counts) <= 7


@pytest.mark.parametrize("seed", [-1, 1.5, True, "3"])
def test_a_seed_that_is_none_is_refused_before_it_is_set(env, seed):
    expected = env.reset(seed=3)["depth"]
    for set_it in (env.set_seed, lambda seed: env.reset(seed=seed)):
        with pytest.raises(ValueError, match="natural number"):
            set_it(seed)
    assert env.base_seed == 3
    assert torch.equal(env.reset(seed=np.int64(3))["depth"], expected)


def test_a_misspelt_keyword_of_a_reset_is_an_error(env):
    with pytest.raises(TypeError, match="'sed'"):
        env.reset(sed=3)


def test_a_reset_of_none_changes_nothing(env):
    state = env.rand_step(env.reset())["next"].exclude("reward")
    after = env.reset(state.clone().set("_reset", torch.zeros(1, dtype=torch.bool)))
    assert torch.equal(after["depth"], state["depth"])
    assert env.rand_step(after)["next", "step_count"] == 2


def test_expert_key_only_on_request(make, env):
    assert "expert_action" not in env.reset().keys()  # noqa: SIM118 -- a TensorDict
    with_expert = make(TASK, obs_size=16, seed=0, expert=True)
    assert with_expert.reset()["expert_action"].shape == (5,)


def test_closing_frees_the_simulator(env):
    env.reset()
    client = env.scene.world.client
    env.close()
    env.close(raise_if_closed=False)
    assert not pybullet.isConnected(physicsClientId=client)
