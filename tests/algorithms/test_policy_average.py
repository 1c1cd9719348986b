"""The moving average of the policy's parameters, with which the policy acts."""

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.core import keys
from tests.algorithms.tiny import build, transitions

ALGORITHMS = ["sac", "bc", "rlpd", "iql", "flow"]


def averaged(name, decay=0.5):
    learner = build(name, optimizer={"policy_average": decay}, batch_size=8)
    learner.extend(transitions(learner))
    return learner


def values(module):
    return [parameter.detach().clone() for parameter in module.parameters()]


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_policy_acts_with_the_average_of_its_parameters(name):
    learner = averaged(name)
    history = []
    for _ in range(3):
        learner.update()
        history.append(values(learner.trained_policy))
    assert not torch.equal(history[0][0], history[2][0])
    for acting, first, second, third in zip(values(learner.policy), *history, strict=True):
        torch.testing.assert_close(acting, 0.25 * first + 0.25 * second + 0.5 * third)


def test_without_a_decay_the_last_parameters_act():
    learner = averaged("sac", decay=0.0)
    learner.update()
    assert learner.averaged_policy is None
    acting, trained = learner.policy.parameters(), learner.trained_policy.parameters()
    assert all(a is b for a, b in zip(acting, trained, strict=True))


def test_the_average_begins_with_the_initial_parameters():
    learner = averaged("sac", decay=0.9)
    pairs = zip(values(learner.policy), values(learner.trained_policy), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_average_is_restored_from_the_state(name):
    learner = averaged(name)
    for _ in range(2):
        learner.update()
    other = averaged(name)
    other.load_state_dict(learner.state_dict())
    state = transitions(learner).select(*learner.policy.in_keys)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        a, b = (each.policy(state.clone())[keys.ACTION] for each in (learner, other))
    assert torch.equal(a, b)
    for each in (learner, other):
        each.averaged_policy.update_parameters(learner.trained_policy)
    pairs = zip(values(learner.policy), values(other.policy), strict=True)
    assert all(torch.equal(x, y) for x, y in pairs)
