"""Ensembles of critics: the batched computation, and its symmetry."""

import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.objectives import CQLLoss, IQLLoss, REDQLoss, SACLoss, SoftUpdate

from ba_torchrl.modules.actor_critic.critics import ActionValue, EnsembleCritic, StateValue
from ba_torchrl.modules.actor_critic.gaussian_policy import squashed_gaussian_policy
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
    depth, holding = torch.rand(2, 1, 64, 64), torch.tensor([[True], [False]])
    action = torch.rand(2, 5) * 2 - 1
    turned = action.clone()
    turned[:, 1], turned[:, 2] = -action[:, 2], action[:, 1]
    values = networks.critic(networks.encoder(depth, holding), action)
    rotated = networks.encoder(torch.rot90(depth, 1, (-2, -1)), holding)
    torch.testing.assert_close(networks.critic(rotated, turned), values, atol=1e-4, rtol=1e-4)
    assert not torch.allclose(networks.critic(rotated, action), values, atol=1e-3)


OBSERVATION = ["depth", "holding"]


def transitions(n=4):
    def state():
        return {"depth": torch.rand(n, 1, 64, 64), "holding": torch.rand(n, 1) > 0.5}

    ends = {name: torch.arange(n)[:, None] == 1 for name in ("done", "terminated")}
    action = 1.8 * torch.rand(n, 5) - 0.9
    following = {**state(), "reward": torch.rand(n, 1), **ends}
    return TensorDict({**state(), "action": action, "next": following}, [n])


KINDS = [SACLoss, CQLLoss, IQLLoss, REDQLoss]
CRITICS = [
    ("cnn", {}),
    ("cnn", {"depth_reference": "floor", "negative_slope": 0.1}),
    ("ferm", {"width": 0.125}),
    ("equi", {}),
    ("equi_strided", {}),
]


@pytest.mark.parametrize(
    ("name", "fields", "kind"),
    [
        pytest.param(*critic, kind, marks=[pytest.mark.slow] * (j != i % len(KINDS)))
        for i, critic in enumerate(CRITICS)
        for j, kind in enumerate(KINDS)
    ],
)
def test_critics_under_vmap_are_a_loop_over_critics(name, fields, kind):
    """The losses of TorchRL, on critics that are whole networks."""
    networks = [actor_critic(name, seed=seed, **fields) for seed in range(3)]
    parts = [squashed_gaussian_policy(networks[0].actor, OBSERVATION)]
    inputs = [*OBSERVATION, "action"]
    values = [ActionValue(each.encoder, each.critic) for each in networks[1:]]
    parts.append([TensorDictModule(value, inputs, ["state_action_value"]) for value in values])
    options = {"target_entropy": -5.0}
    if kind is IQLLoss:
        state_value = StateValue(networks[0].encoder, networks[0].critic, 5)
        parts.append(TensorDictModule(state_value, OBSERVATION, ["state_value"]))
        options = {}
    if kind is CQLLoss:
        options["action_spec"] = Bounded(-1.0, 1.0, (5,))
    if kind is REDQLoss:
        options |= {"num_qvalue_nets": 2, "sub_sample_len": 1}
    data, found = transitions(), []
    for is_loop in (False, True):
        loss = kind(*parts, **options, deactivate_vmap=is_loop)
        SoftUpdate(loss, tau=0.01)
        torch.manual_seed(1)
        terms = {key: x for key, x in loss(data.clone()).items() if key.startswith("loss_")}
        sum(terms.values()).backward()
        gradient = loss.qvalue_network_params["module", "encoder"].flatten_keys()
        found.append((terms, {key: value.grad for key, value in gradient.items()}))
    torch.testing.assert_close(found[0], found[1], atol=1e-4, rtol=1e-4)
