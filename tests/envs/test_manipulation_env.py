import logging

import pybullet
import pytest
import torch
from torchrl.collectors import Collector

import ba_torchrl
from ba_torchrl.envs import faults
from ba_torchrl.envs.checks import checked_action
from ba_torchrl.errors import InvalidActionError, SimulationError

TASK = "close_loop/block_picking"


@pytest.fixture
def env():
    env = ba_torchrl.make(TASK, obs_size=16, seed=0)
    yield env
    if not env.is_closed:
        env.close()


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


def test_the_same_seed_gives_the_same_pixels_in_serial_and_parallel():
    policy = lambda td: td.set("action", torch.full((2, 5), -0.4))  # noqa: E731
    rollouts = []
    for parallel in (True, False):
        env = ba_torchrl.make_vector_env(
            TASK, 2, parallel=parallel, start_method="spawn", obs_size=16, seed=5
        )
        rollouts.append(env.rollout(6, policy, break_when_any_done=False))
        env.close()
    assert torch.equal(rollouts[0]["next", "depth"], rollouts[1]["next", "depth"])
    assert not torch.equal(rollouts[0]["depth"][0, 0], rollouts[0]["depth"][1, 0])


def test_a_simulator_fault_ends_the_episode_truncated(env, monkeypatch, caplog):
    state = env.reset()
    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(env.scene.controller, "move_to", _fail)
        following = env.step(state.set("action", torch.zeros(5)))["next"]
    assert following["fault"]
    assert following["truncated"]
    assert not following["terminated"]
    assert following["reward"] == 0
    assert env.faults == 1
    assert "simulator fault" in caplog.text
    assert "the solver exploded" in caplog.text
    state = env.reset()
    assert not env.step(state.set("action", torch.zeros(5)))["next", "fault"]


def test_repeated_faults_are_an_error(env, monkeypatch):
    monkeypatch.setattr(faults, "MAX_CONSECUTIVE_FAULTS", 2)
    monkeypatch.setattr("ba_torchrl.sim.control.close_loop.CloseLoopController.move_to", _fail)
    for _ in range(2):
        assert env.step(env.reset().set("action", torch.zeros(5)))["next", "fault"]
    with pytest.raises(SimulationError, match="3 times in a row"):
        env.step(env.reset().set("action", torch.zeros(5)))


def _fail(*_):
    raise SimulationError("the solver exploded")


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


def test_expert_key_only_on_request(env):
    assert "expert_action" not in env.reset().keys()  # noqa: SIM118 -- a TensorDict
    with_expert = ba_torchrl.make(TASK, obs_size=16, seed=0, expert=True)
    assert with_expert.reset()["expert_action"].shape == (5,)
    with_expert.close()


def test_closing_frees_the_simulator(env):
    env.reset()
    client = env.scene.world.client
    env.close()
    env.close(raise_if_closed=False)
    assert not pybullet.isConnected(physicsClientId=client)
