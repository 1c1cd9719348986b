"""RLPD: what it adds to SAC has an effect, and it runs."""

import dataclasses

import pytest
import torch

from ba_torchrl.algorithms.base import ALGORITHMS
from ba_torchrl.core.config import parse
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.data.replay.symmetric import SymmetricSampler
from ba_torchrl.modules.actor_critic.cnn import CNNConfig
from tests.algorithms.tiny import build, problem, run, transitions

UNUSUAL = {
    "optimizer": {"learning_rate": 0.003},
    "tau": 0.3,
    "critics": 5,
    "subset": 3,
    "critic_updates": 3,
    "entropy_backup": True,
    "batch_size": 6,
}


def made(**changes):
    learner = build("rlpd", **{**UNUSUAL, **changes})
    learner.extend(transitions(learner))
    return learner


def flat(params):
    return torch.cat([value.detach().flatten() for value in params.values(True, True)])


def test_the_hyper_parameters_have_an_effect():
    learner = made()
    assert (learner.loss.subset, learner.loss.entropy_backup) == (3, True)
    assert learner.loss.qvalue_network.module.heads == 5
    assert isinstance(learner.replay.sampler, SymmetricSampler)


def test_an_update_is_several_critic_updates_and_one_of_the_policy():
    learner = made()
    target = flat(learner.loss.target_qvalue_network_params)
    taken = []
    step, sample = learner.step, learner.sample
    drawn = []

    def record(batch, stages):
        before = flat(learner.loss.actor_network_params), flat(learner.loss.qvalue_network_params)
        step(batch, stages)
        after = flat(learner.loss.actor_network_params), flat(learner.loss.qvalue_network_params)
        taken.append(tuple(not torch.equal(*pair) for pair in zip(before, after, strict=True)))
        nonlocal target
        target = 0.7 * target + 0.3 * after[1]

    learner.step = record
    learner.sample = lambda: drawn.append(sample()) or drawn[-1]
    learner.update()
    assert taken == [(False, True), (False, True), (True, True)]
    assert learner.updates == 1
    torch.testing.assert_close(flat(learner.loss.target_qvalue_network_params), target)
    assert not torch.equal(drawn[0]["action"], drawn[1]["action"])


def test_a_restored_learner_draws_the_same_subsets():
    first, second = made(), made()
    first.update()
    second.load_state_dict(first.state_dict())
    states = [learner.loss.generator.get_state() for learner in (first, second)]
    assert torch.equal(*states)


def test_what_cannot_be_built_is_refused():
    with pytest.raises(ConfigError, match="subset"):
        build("rlpd", critics=3, subset=4)
    with pytest.raises(ConfigError, match="batch_size must be at least 2"):
        build("rlpd", batch_size=1)
    with pytest.raises(ConfigError, match="replay"):
        parse(ALGORITHMS["rlpd"], {"replay": {"name": "uniform"}}, "rlpd")


def test_a_network_without_an_ensemble_is_refused():
    class Twins(CNNConfig):
        def build(self, spec):
            return super().build(dataclasses.replace(spec, critics=None))

    with pytest.raises(ConfigError, match="network 'Twins' builds no ensemble"):
        ALGORITHMS["rlpd"]().build(Twins(width=0.25), problem())
    learner = ALGORITHMS["iql"]().build(Twins(width=0.25), problem())  # takes one of the twins
    learner.extend(transitions(learner))
    learner.update()


def test_two_iterations_of_a_run(tmp_path):
    learner = run(tmp_path, "cnn", {"name": "rlpd", "critics": 3, "critic_updates": 2})
    assert 0 < learner.replay.num_demonstrations < len(learner.replay)


@pytest.mark.parametrize(("init", "first"), [("random", {}), ("bc", {"updates": 3})])
def test_the_learning_rate_ends_with_the_run(init, first):
    """An update of behaviour cloning is one step, one of RLPD several."""
    schedule = {"learning_rate": 0.003, "learning_rate_end_factor": 0.1}
    settings = {**UNUSUAL, "optimizer": schedule, "init": {"name": init, **first}}
    config = parse(ALGORITHMS["rlpd"], settings, "rlpd")
    task = dataclasses.replace(problem(), total_updates=6)
    learner = config.build(CNNConfig(width=0.25), task)
    learner.extend(transitions(learner))
    for _ in range(5):
        learner.update()
    rate = learner.optimizer.param_groups[0]["lr"]
    assert rate > 0.15 * 0.003
    learner.update()
    assert learner.optimizer.param_groups[0]["lr"] == pytest.approx(0.1 * 0.003)
