"""Noise on the actions that SAC collects, and of modules of one's own that always act."""

import pytest
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from ba_torchrl.algorithms.base import Learner
from ba_torchrl.algorithms.sac import SAC
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from tests.algorithms.tiny import OPEN, build, make_experiment, transitions
from tests.tasks.episodes import slow
from tests.training.collectors.runs import config_for, start

SIGMA = 0.2


class OwnNoise(TensorDictModuleBase):
    """Noise without a condition of its own, which records under which type it is called."""

    in_keys = out_keys = (keys.ACTION,)

    def __init__(self):
        super().__init__()
        self.called_under = []

    def forward(self, tensordict):
        self.called_under.append(exploration_type())
        action = tensordict[keys.ACTION]
        return tensordict.set(keys.ACTION, action + 1e-3 * torch.randn_like(action))


@pytest.fixture
def own_noise(monkeypatch):
    for learner in (Learner, SAC):
        monkeypatch.setattr(learner, "make_exploration", lambda _: OwnNoise())


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


@pytest.mark.parametrize("name", ["bc", "flow", "iql", "rlpd", "sac"])
@pytest.mark.parametrize("kind", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC, None])
def test_noise_of_ones_own_acts_under_random_only(own_noise, name, kind):
    learner = build(name)
    seen = transitions(learner, 8).exclude(keys.ACTION, keys.NEXT)
    noise = next(each for each in learner.policy.modules() if isinstance(each, OwnNoise))
    with torch.no_grad(), set_exploration_type(kind):
        found = [learner.policy(seen.clone())[keys.ACTION] for _ in range(4)]
    is_random = kind is ExplorationType.RANDOM
    assert noise.called_under == [kind] * 4 * is_random
    if not is_random:
        assert all(torch.equal(found[0], each) for each in found)


@pytest.mark.parametrize("changes", [*slow([{"parallel": True, "start_method": "fork"}]), OPEN])
def test_a_run_with_noise_of_ones_own_is_evaluated_without(tmp_path, own_noise, changes):
    name, network = ("spatial_q", "asr") if changes is OPEN else ("sac", "cnn")
    experiment = make_experiment(tmp_path, network, {"name": name}, **changes)
    experiment.run()
    noise = experiment.learner.policy.exploration
    assert noise.called_under == [ExplorationType.RANDOM] * 2  # its updates, one step each


@pytest.mark.parametrize("kind", ["multi_sync", *slow(["multi_async"])])
def test_workers_collect_with_noise_of_ones_own(tmp_path, own_noise, kind):
    settings = {"name": "spatial_q", "epsilon_init": 0.0, "epsilon_end": 0.0, "batch_size": 8}
    collector = {"name": kind, "workers": 2}
    network = {"name": "asr", "num_rotations": 4, "width": 0.125}
    config = config_for(tmp_path, collector, algorithm=settings, network=network, **OPEN)
    collection, learner = start(config)
    try:
        batch = next(collection)
    finally:
        collection.close()
    greedy = learner.policy(batch.select(*learner.policy.in_keys))[keys.ACTION]
    error = (batch[keys.ACTION] - greedy).abs()
    assert 0 < error.max() < 0.01


def test_negative_noise_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="exploration_noise"):
        make_experiment(tmp_path, "cnn", {"name": "sac", "exploration_noise": -0.1})
