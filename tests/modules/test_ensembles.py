"""Ensembles of critics: the batched computation, and its symmetry."""

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from ba_torchrl.modules.actor_critic.critics import EnsembleCritic
from tests.modules.networks import actor_critic


def perturb(module):
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))


def test_a_batch_of_heads_is_a_loop_over_heads():
    torch.manual_seed(0)
    critic = EnsembleCritic(nn.Linear(4 + 2, 3 * 5), heads=3, fields=5)
    perturb(critic)
    features, action = torch.randn(7, 2, 4), torch.randn(7, 2, 2)
    x = torch.cat([features, action], dim=-1)
    values = []
    for k in range(3):
        rows = slice(5 * k, 5 * k + 5)
        h = F.linear(x, critic.first.weight[rows], critic.first.bias[rows])
        norm = critic.first_norm
        h = F.relu(F.layer_norm(h, [5], norm.weight[k, :, 0], norm.bias[k, :, 0]))
        h = h @ critic.second.weight[k] + critic.second.bias[k]
        norm = critic.second_norm
        h = F.relu(F.layer_norm(h, [5], norm.weight[k, :, 0], norm.bias[k, :, 0]))
        values.append((h @ critic.values.weight[k] + critic.values.bias[k])[..., 0])
    torch.testing.assert_close(critic(features, action), torch.stack(values, dim=-1))


def test_heads_start_different():
    critic = actor_critic("cnn", critics=3).critic
    (values,) = critic(torch.rand(1, 32), torch.zeros(1, 5)).detach()
    assert values.shape == (3,)
    assert values.unique().numel() == 3


@pytest.mark.parametrize("name", ["cnn", "equi"])
def test_two_critics_without_an_ensemble_are_none(name):
    assert not isinstance(actor_critic(name).critic, EnsembleCritic)


def test_the_values_of_an_equivariant_ensemble_are_invariant():
    networks = actor_critic("equi", critics=4)
    perturb(networks.critic.first_norm)
    perturb(networks.critic.second_norm)
    pixels, holding = torch.rand(2, 1, 64, 64), torch.tensor([[True], [False]])
    action = torch.rand(2, 5) * 2 - 1
    turned = action.clone()
    turned[:, 1], turned[:, 2] = -action[:, 2], action[:, 1]
    values = networks.critic(networks.encoder(pixels, holding), action)
    rotated = networks.encoder(torch.rot90(pixels, 1, (-2, -1)), holding)
    torch.testing.assert_close(networks.critic(rotated, turned), values, atol=1e-4, rtol=1e-4)
    assert not torch.allclose(networks.critic(rotated, action), values, atol=1e-3)
