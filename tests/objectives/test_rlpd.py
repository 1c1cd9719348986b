"""RLPD's loss against arithmetic on linear networks."""

import math

import pytest
import torch

from ba_torchrl.envs import keys
from ba_torchrl.objectives.rlpd import RLPDLoss
from tests import linear_sac
from tests.linear_sac import batch

CRITICS, ALPHA, GAMMA = 4, 0.2, 0.9


def make(draws=0, **settings):
    options = {"kind": RLPDLoss, "critics": CRITICS, "alpha_init": ALPHA, "target_entropy": -1.5}
    loss = linear_sac.make(**options, **settings)
    loss.generator.manual_seed(draws)
    return loss.make_value_estimator(gamma=GAMMA).double()


def affine(params, x):
    return x @ params["module", "net", "weight"].T + params["module", "net", "bias"]


def inputs(state):
    return torch.cat([state[keys.PIXELS], state[keys.HOLDING].double()], dim=-1)


def policy_of(loss, state):
    params = loss.actor_network_params.data["module", "0"]
    action = affine(params, inputs(state)).tanh()
    log_std = params["module", "log_std"]
    return action, (action.sum(-1) + log_std.sum()) / 2


def values_of(loss, state, action, prefix=""):
    encoder = getattr(loss, f"{prefix}encoder_network_params").data
    critic = getattr(loss, f"{prefix}qvalue_network_params").data
    features = affine(encoder, inputs(state)).tanh()
    return affine(critic, torch.cat([features, action], dim=-1))


def target_of(loss, data, chosen, entropy_backup):
    action, log_prob = policy_of(loss, data[keys.NEXT])
    q = values_of(loss, data[keys.NEXT], action, "target_")[:, chosen].amin(dim=1)
    q = q - ALPHA * log_prob if entropy_backup else q
    goes_on = (~data[keys.NEXT, keys.TERMINATED][:, 0]).double()
    return data[keys.NEXT, keys.REWARD][:, 0] + GAMMA * goes_on * q


@pytest.mark.parametrize("entropy_backup", [False, True])
def test_the_terms_are_those_of_the_formula(entropy_backup):
    loss, data = make(subset=CRITICS, entropy_backup=entropy_backup), batch(weights=None)
    found = loss(data)
    y = target_of(loss, data, range(CRITICS), entropy_backup)
    q = values_of(loss, data, data[keys.ACTION])
    torch.testing.assert_close(
        found["loss_qvalue"].detach(), (q - y[:, None]).square().sum(1).mean()
    )
    action, log_prob = policy_of(loss, data)
    q_pi = values_of(loss, data, action).mean(dim=1)
    torch.testing.assert_close(found["loss_actor"].detach(), (ALPHA * log_prob - q_pi).mean())
    expected = -(math.log(ALPHA) * (log_prob - 1.5)).mean()
    torch.testing.assert_close(found["loss_alpha"].detach(), expected)
    torch.testing.assert_close(found["q_value"], q.mean())
    torch.testing.assert_close(found["q_std"], q.std(dim=1).mean())


def test_targets_are_from_random_subsets_of_the_given_size():
    loss, data = make(subset=2, draws=3), batch(weights=None)
    pairs = [(i, j) for i in range(CRITICS) for j in range(i)]
    # pairs with the same lowest critic have the same target
    candidates = torch.stack([target_of(loss, data, pair, False) for pair in pairs])
    expected = {tuple(row) for row in candidates.numpy().round(6).tolist()}
    drawn = {tuple(loss._target(data)[:, 0].numpy().round(6).tolist()) for _ in range(60)}
    assert drawn == expected
    assert len(expected) >= 3


def test_the_critics_alone_have_the_same_loss():
    first, second, data = make(draws=1), make(draws=1), batch(weights=None)
    critic = first.critic_loss(data)
    assert "loss_actor" not in critic
    torch.testing.assert_close(critic["loss_qvalue"], second(data)["loss_qvalue"])
