"""The update with escnn's layers, against which updates are measured."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from ba_torchrl.core import keys
from ba_torchrl.modules.actor_critic.gaussian_policy import squashed_gaussian_policy
from ba_torchrl.modules.base import NETWORKS, ActorCriticSpec
from ba_torchrl.objectives.sacfd import SACfDLoss
from tests.specs import close_loop_images

pytest.importorskip("profiling.planar_escnn")

from profiling import escnn_update

PIXELS = 64


@pytest.fixture
def escnn():
    torch.manual_seed(0)
    return escnn_update.EscnnSACfD(4, PIXELS, 4)


def batch(count=6):
    generator = torch.Generator().manual_seed(0)

    def rand(*shape):
        return torch.rand(count, *shape, generator=generator)

    def state():
        return {keys.DEPTH: 0.3 * rand(1, PIXELS, PIXELS), keys.HOLDING: rand(1) < 0.5}

    ended = rand(1) < 0.5
    ends = {keys.REWARD: rand(1), keys.DONE: ended, keys.TERMINATED: ended}
    data = {
        **state(),
        keys.ACTION: 1.8 * rand(5) - 0.9,
        keys.IS_DEMONSTRATION: torch.arange(count)[:, None] % 2 == 0,
        keys.NEXT: {**state(), **ends},
    }
    return TensorDict(data, [count])


class Features(nn.Module):
    """The features of a critic's trunk, for a loss that shares them between its terms."""

    def __init__(self, critic):
        super().__init__()
        self.trunk = critic.trunk

    def forward(self, depth, holding):
        return self.trunk(depth, holding).flatten(1)


class Heads(nn.Module):
    """The value heads of a critic on its features."""

    def __init__(self, critic):
        super().__init__()
        self.critic = critic
        self.critic.trunk = nn.Identity()

    def forward(self, features, action):
        self.critic.trunk.forward = lambda *_: features[..., None, None]
        return self.critic(None, None, action)


def test_network_and_losses_are_those_of_sacfd(escnn):
    ours = NETWORKS["equi"](n_hidden=4, group_order=4, precision="float32").build(
        ActorCriticSpec(close_loop_images(PIXELS), "pxyzr")
    )
    for found, expected in (
        (escnn.actor, [ours.actor]),
        (escnn.critic, [ours.encoder, ours.critic]),
    ):
        counts = [p.numel() for module in expected for p in module.parameters()]
        assert sum(p.numel() for p in found.parameters()) == sum(counts)

    data = batch()
    torch.manual_seed(5)
    qvalue = escnn.qvalue_loss(data)
    actor, log_prob = escnn.actor_loss(data)
    features = Features(escnn.critic)
    observation = [keys.DEPTH, keys.HOLDING]
    loss = SACfDLoss(
        squashed_gaussian_policy(escnn.actor, observation),
        TensorDictModule(features, observation, ["features"]),
        TensorDictModule(Heads(escnn.critic), ["features", keys.ACTION], ["state_action_value"]),
    )
    loss.make_value_estimator(gamma=0.99)
    torch.manual_seed(5)
    expected = loss(data)
    torch.testing.assert_close(qvalue, expected["loss_qvalue"], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(actor, expected["loss_actor"], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(-log_prob.mean(), expected["entropy"], rtol=1e-4, atol=1e-6)
