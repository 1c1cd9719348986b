"""The protocol of tests: seeds that no run has, and results that depend on the seeds only."""

import numpy as np
import pytest
import torch

from ba_torchrl import make, make_vector_env
from ba_torchrl.algorithms.base import SeedUse, derive_seed
from ba_torchrl.core import keys
from ba_torchrl.core.config import FIRST_TEST_SEED, MAX_ENVS, MAX_SEED
from ba_torchrl.demonstrations import episodes as played
from ba_torchrl.envs.vector.batching import SerialVectorEnv
from ba_torchrl.training import protocol

HEAP = ("close_loop/object_grasping", {"num_objects": 2, "max_steps": 3})
PICKING = ("close_loop/block_picking", {"max_steps": 9})


def test_no_other_use_of_a_seed_can_be_a_test_seed():
    seeds = [protocol.test_seed(episode) for episode in range(protocol.TEST_EPISODES)]
    assert len(set(seeds)) == len(seeds)
    assert MAX_SEED + MAX_ENVS < FIRST_TEST_SEED == min(seeds)
    assert max(seeds) < 2**53  # exact in JSON
    largest = (derive_seed(seed, use, 10**6) for seed in (0, MAX_SEED) for use in SeedUse)
    assert max(largest) < 2**32


def test_episodes_of_tests_are_not_those_of_smaller_seeds():
    """NumPy takes [2**33, 0] and [0, 2] for the same seed."""
    assert draws([2**33, 0]) == draws([0, 2])
    upper, lower = divmod(FIRST_TEST_SEED, 2**32)
    assert draws([FIRST_TEST_SEED, 0]) == draws([lower, upper])
    assert upper > 10**6  # episodes of one environment
    assert lower + protocol.TEST_EPISODES < 2**32


def draws(seed):
    return np.random.default_rng(seed).integers(2**32, size=4).tolist()


def acts(observation):
    """Follow the expert, with an error that depends on the image and on the size of the batch."""
    action = observation[keys.EXPERT_ACTION].clone()
    image = observation[keys.DEPTH].flatten(1).sum(1)
    action[..., 1] += 0.3 * torch.sin(1e4 * len(observation) * image)
    return observation.set(keys.ACTION, action.clamp(-1, 1))


def test_a_result_does_not_depend_on_the_environments():
    task, options = PICKING

    def found(num_envs, *, parallel):
        env = make_vector_env(
            task,
            num_envs,
            parallel=parallel,
            start_method="fork",
            seed=num_envs,
            expert=True,
            obs_size=32,
            **options,
        )
        try:
            return protocol.run_test(env, acts, 7, 5)
        finally:
            env.close()

    one = found(1, parallel=False)
    assert one == found(3, parallel=False) == found(3, parallel=True) == found(8, parallel=False)
    assert one.seeds == [protocol.test_seed(episode) for episode in range(5)]
    assert (one.updates, one.episodes) == (7, 5)
    assert len(set(one.lengths)) > 1


def test_each_episode_is_that_of_its_seed():
    """A heap that the episode before left is not continued."""
    task, options = HEAP
    env = make(task, expert=True, obs_size=32, **options)
    vector = SerialVectorEnv(2, lambda: make(task, expert=True, obs_size=32, **options))
    starts = {}

    def record(state):
        for row in state.unbind(0):
            if not row[keys.STEP_COUNT]:
                starts.setdefault(round(float(row[keys.DEPTH].double().sum()), 9), row[keys.DEPTH])
        return acts(state)

    protocol.run_test(vector, record, 0, 5)
    vector.close()
    expected = [env.reset(seed=protocol.test_seed(episode))[keys.DEPTH] for episode in range(5)]
    env.close()
    assert len(starts) == 5
    for image in expected:
        assert any(torch.equal(image, start) for start in starts.values())


@pytest.mark.parametrize(("faults", "successes"), [(2, 1), (3, 0)])
def test_an_episode_with_faults_is_repeated_and_then_fails(faults, successes, monkeypatch):
    """The first step of the first episode has ``faults`` faults, one in each attempt."""
    task, options = PICKING
    vector = SerialVectorEnv(1, lambda: make(task, expert=True, obs_size=32, **options))
    original, seen = SerialVectorEnv._step, []

    def step(self, tensordict):
        out = original(self, tensordict)
        if len(seen) < faults:
            seen.append(None)
            for key in (keys.FAULT, keys.TRUNCATED, keys.DONE):
                out[key] = torch.ones(1, 1, dtype=torch.bool)
        return out

    monkeypatch.setattr(SerialVectorEnv, "_step", step)
    expert = lambda state: state.set(keys.ACTION, state[keys.EXPERT_ACTION])  # noqa: E731
    found = protocol.run_test(vector, expert, 0, 2)
    vector.close()
    assert found.successes == [successes, 1]
    assert (found.lengths[0] == 1) == (not successes)
    assert played.FAULTY_ATTEMPTS == 3
