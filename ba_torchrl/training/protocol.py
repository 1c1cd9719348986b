"""The protocol of tests: which episodes a policy is tested in. Its page is docs/protocol.md.

The seeds of a test are the same for all runs, policies and methods. They are above `MAX_SEED`, the
largest seed that a run, a command or a derived seed can have, so that no training, demonstration or
selection of a checkpoint has seen them.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.algorithms.acting import constant_weights
from ba_torchrl.core.config import FIRST_TEST_SEED, PROTOCOL as PROTOCOL
from ba_torchrl.demonstrations.episodes import is_success, play_seeds
from ba_torchrl.envs.checks import check_policy
from ba_torchrl.envs.policies import Policy
from ba_torchrl.record.results import PolicyTest

TEST_EPISODES = 500
"""Episodes of a number that is cited."""
ROWS = 5
"""Batch size of a policy in a test, whatever the number of environments."""


def test_seed(episode: int) -> int:
    """Return the seed of an episode of a test, from 0; the episode is ``env.reset(seed=...)``."""
    return FIRST_TEST_SEED + episode


def run_test(
    env: EnvBase,
    policy: Policy,
    updates: int,
    episodes: int = TEST_EPISODES,
    on_episode: Callable[[TensorDict], None] | None = None,
    first_seed: int = FIRST_TEST_SEED,
) -> PolicyTest:
    """Test a policy: play the protocol's first episodes greedily, with constant weights.

    The result does not depend on the environments' number and processes: the policy acts on batches
    of `ROWS`, since a network computes other last bits for another batch size.

    Args:
        env: a vector of environments.
        policy: acts greedily under TorchRL's deterministic exploration type, on a batch [`ROWS`].
        updates: gradient updates of the policy.
        episodes: their number.
        on_episode: called with each episode when it ends, for progress bars.
        first_seed: of the episodes; with another than the protocol's, it is no test.
    """
    check_policy(policy, env)
    seeds = [first_seed + episode for episode in range(episodes)]
    with set_exploration_type(ExplorationType.DETERMINISTIC), constant_weights():
        played = play_seeds(env, _in_batches(policy), seeds, on_episode)
    return PolicyTest(
        updates=updates,
        seeds=seeds,
        successes=[int(is_success(episode)) for episode in played],
        lengths=[len(episode) for episode in played],
    )


def _in_batches(policy: Policy) -> Policy:
    """Return a policy that acts on batches of `ROWS`; the last batch repeats its last row."""

    def act(observation: TensorDictBase) -> TensorDictBase:
        (count,) = observation.batch_size
        if count == ROWS:
            return policy(observation)
        rows = torch.arange(-(-count // ROWS) * ROWS, device="cpu").clamp(max=count - 1)
        return torch.cat([policy(observation[batch]) for batch in rows.split(ROWS)])[:count]

    return act


def count_parameters(policy: nn.Module) -> int:
    """Return the number of parameters of an acting policy."""
    return sum(parameter.numel() for parameter in policy.parameters())
