"""The behaviour term of the SACfD loss."""

import itertools

import pytest
import torch
from torch.distributions import Bernoulli, kl_divergence

from ba_torchrl.envs import keys
from tests.linear_sac import batch, make

EXPERTS = (True, True, False, True)
WEIGHTS = (0.2, 0.8, 0.4, 0.1)


def test_behaviour_term_pulls_the_sample_to_the_expert():
    loss = make(alpha_init=1e-9, demonstration_weight=1.0)
    data = batch()
    with torch.no_grad():  # critics that do not care
        loss.qvalue_network_params["module", "net", "weight"].zero_()
    optimizer = torch.optim.SGD(loss.actor_network_params.parameters(), 0.1)
    errors = []
    for _ in range(20):
        out = loss(data.clone())
        errors.append(float(out["demonstration_error"]))
        optimizer.zero_grad()
        out["loss_actor"].backward()
        optimizer.step()
    assert all(later < earlier for earlier, later in itertools.pairwise(errors))


def test_the_term_with_the_divergence_of_actions():
    data = batch(EXPERTS, WEIGHTS)
    data[keys.ACTION][0, 0] = 1.0  # at the end of the range, as the gripper's commands are
    options = {"demonstration_distance": "kl", "weighted_terms": "all"}
    loss = make(demonstration_weight=0.3, **options)
    with torch.no_grad(), loss.actor_network_params.to_module(loss.actor_network):
        action = loss.actor_network.get_dist(data).rsample()
    expert, policy = (Bernoulli((1 + value) / 2) for value in (data[keys.ACTION], action))
    distances = 2 * kl_divergence(expert, policy).mean(dim=-1)
    found = loss(data.clone())
    flags = torch.tensor(EXPERTS)
    torch.testing.assert_close(found["demonstration_error"], distances[flags].mean())
    weights = torch.tensor(WEIGHTS, dtype=distances.dtype) / max(WEIGHTS)
    without = make(demonstration_weight=0.0, **options)(data.clone())  # with the same parameters
    difference = found["loss_actor"] - without["loss_actor"]
    assert difference.item() == pytest.approx(
        0.3 * (weights * distances)[flags].mean().item(), rel=1e-5
    )


def test_the_term_is_against_the_entry_of_the_expert():
    data, executed = batch(EXPERTS), batch(EXPERTS)
    data["label"] = data[keys.ACTION].clone()
    data[keys.ACTION] = -data[keys.ACTION] / 3  # what was executed in place of the expert's action
    loss = make(demonstration_weight=0.3)
    loss.set_keys(target_action="label")
    assert {"label", keys.ACTION} <= set(loss.in_keys)
    found, expected = loss(data), make(demonstration_weight=0.3)(executed)
    for name in ("loss_actor", "demonstration_error", "entropy"):
        torch.testing.assert_close(found[name], expected[name])
    assert not torch.allclose(found["loss_qvalue"], expected["loss_qvalue"])
    with pytest.raises(KeyError, match="label"):
        loss(data.exclude("label"))
