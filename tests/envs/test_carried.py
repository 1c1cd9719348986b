"""Entries that a policy carries to the next step, in everything that plays episodes."""

from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import pytest
import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import SerialEnv

import ba_torchrl
from ba_torchrl.algorithms.acting import ActingPolicy
from ba_torchrl.algorithms.imitation import MixedPolicy
from ba_torchrl.core import keys
from ba_torchrl.demonstrations.episodes import collect_episodes
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.tasks.base import versions_of
from ba_torchrl.training import protocol
from ba_torchrl.training.collectors.workers import VersionedPolicy
from ba_torchrl.training.evaluation import acting_on, record_episodes
from ba_torchrl.training.policy import TrainedPolicy

TASK = "close_loop/block_reaching"
SMALL = {"obs_size": 16, "seed": 0, "max_steps": 5}
COUNT = (keys.CARRIED, "count")


class Counting(TensorDictModuleBase):
    """Counts the steps of each environment by what it carries, and not by ``step_count``."""

    calls: ClassVar[list[int]] = []

    def __init__(self):
        super().__init__()
        self.in_keys, self.out_keys = [keys.STEP_COUNT], [keys.ACTION, COUNT]
        self.unused = nn.Parameter(torch.zeros(()))  # its device is the policy's

    def forward(self, tensordict):
        first = tensordict[keys.STEP_COUNT] == 0
        count = torch.where(first, 0, tensordict.get(COUNT, torch.zeros_like(first).long()) + 1)
        is_playing = tensordict[keys.STEP_COUNT] < SMALL["max_steps"]
        assert (count == tensordict[keys.STEP_COUNT])[is_playing].all()
        self.calls.append(len(count))
        action = torch.zeros(*tensordict.batch_size, 5)
        action[..., 0] = count[..., 0] % 2
        return tensordict.set(COUNT, count).set(keys.ACTION, action)


@pytest.fixture
def policy():
    Counting.calls.clear()
    yield Counting()
    assert len(Counting.calls) >= 5


@pytest.mark.parametrize("num_envs", [1, 8])
def test_the_protocols_test_keeps_them_per_episode(policy, num_envs):
    env = ba_torchrl.make_vector_env(TASK, num_envs, parallel=False, **SMALL)
    test = protocol.run_test(env, ActingPolicy(policy, []), 0, episodes=9)
    assert test.lengths == [5] * 9
    env.close()


def test_collected_episodes_keep_them(policy):
    env = ba_torchrl.make_vector_env(TASK, 2, parallel=False, **SMALL)
    episodes = collect_episodes(env, acting_on(policy, torch.device("cpu")), 4)
    assert [episode[COUNT].flatten().tolist() for episode in episodes] == [list(range(5))] * 4
    env.close()


@pytest.mark.parametrize(
    "wrapped",
    [lambda policy: ActingPolicy(policy, []), lambda policy: MixedPolicy(policy, None, 0)],
)
def test_a_trained_policy_passes_them_on(policy, wrapped):
    resolved = resolve_env(TASK, SMALL)
    learner = SimpleNamespace(policy=wrapped(policy), images={}, vectors={})
    config = SimpleNamespace(task=TASK, env=resolved)
    trained = TrainedPolicy(learner, config, 0, Path("runs"), versions_of(TASK))
    env = ba_torchrl.make(resolved)
    assert env.rollout(5, trained)[COUNT].flatten().tolist() == list(range(5))
    env.close()


def test_recorded_episodes_keep_them(policy):
    record_episodes(resolve_env(TASK, SMALL), policy, 2, seed=0)


@pytest.mark.parametrize("wrapped", [lambda policy: policy, VersionedPolicy])
def test_torchrls_rollouts_and_collectors_keep_them(policy, wrapped):
    policy = wrapped(policy)
    assert COUNT in policy.out_keys
    env = ba_torchrl.make(TASK, **SMALL)
    assert env.rollout(5, policy)[COUNT].flatten().tolist() == list(range(5))
    vector = SerialEnv(2, lambda: ba_torchrl.make(TASK, **SMALL))
    collector = Collector(
        vector,
        policy,
        frames_per_batch=24,
        total_frames=24,
        auto_register_policy_transforms=False,
    )
    for data in collector:
        assert data[COUNT][0].flatten().tolist() == [*range(5), *range(5), 0, 1]
    collector.shutdown()
