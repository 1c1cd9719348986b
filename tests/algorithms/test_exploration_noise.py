"""Noise on the actions that SAC collects."""

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.envs import keys
from ba_torchrl.errors import ConfigError
from tests.algorithms.tiny import build, make_experiment, transitions

SIGMA = 0.2


def actions(noise, exploration, count=400):
    learner = build("sac", exploration_noise=noise)
    seen = transitions(learner, count).select(*learner.observation_keys)
    torch.manual_seed(0)
    with torch.no_grad(), set_exploration_type(exploration):
        return learner.policy(seen)[keys.ACTION]


def test_collected_actions_have_the_noise():
    found = actions(SIGMA, ExplorationType.RANDOM)
    sampled = actions(0.0, ExplorationType.RANDOM)
    noise = torch.randn(sampled.shape)  # the draws that follow those of the policy
    torch.testing.assert_close(found, (sampled + SIGMA * noise).clamp(-1, 1))


def test_greedy_actions_have_none():
    with_noise = actions(SIGMA, ExplorationType.DETERMINISTIC)
    assert torch.equal(with_noise, actions(0.0, ExplorationType.DETERMINISTIC))


def test_actions_stay_in_their_range():
    found = actions(3.0, ExplorationType.RANDOM)
    assert found.min() == -1
    assert found.max() == 1


@pytest.mark.parametrize(
    "collector", ["single", pytest.param("multi_sync", marks=pytest.mark.slow)]
)
def test_a_run_collects_with_noise(tmp_path, collector):
    algorithm = {"name": "sac", "exploration_noise": SIGMA}
    settings = {"collector": {"name": collector}, "total_updates": 2, "eval_every": 2}
    assert make_experiment(tmp_path, "cnn", algorithm, **settings).run().updates == 2


def test_negative_noise_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="exploration_noise"):
        make_experiment(tmp_path, "cnn", {"name": "sac", "exploration_noise": -0.1})
