"""A SACfD loss with linear networks, and a batch for it."""

import torch
from tensordict import TensorDict
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import nn
from torchrl.objectives import SoftUpdate

from ba_torchrl.core import keys
from ba_torchrl.objectives.sacfd import SACfDLoss


class LinearPolicy(nn.Module):
    """loc = W [depth, holding], scale constant per component."""

    def __init__(self):
        super().__init__()
        self.net = nn.Linear(3, 2)
        self.log_std = nn.Parameter(torch.tensor([-0.5, -1.0]))

    def reset_parameters(self):
        nn.init.uniform_(self.log_std, -1, 0)

    def forward(self, depth, holding):
        x = torch.cat([depth, holding.to(depth.dtype)], dim=-1)
        loc = self.net(x)
        return loc, self.log_std.exp().expand_as(loc)


class LinearEncoder(nn.Module):
    def __init__(self):
        super().__init__()
        self.net = nn.Linear(3, 4)

    def forward(self, depth, holding):
        return torch.tanh(self.net(torch.cat([depth, holding.to(depth.dtype)], dim=-1)))


class LinearCritics(nn.Module):
    def __init__(self, critics):
        super().__init__()
        self.net = nn.Linear(6, critics)

    def forward(self, features, action):
        return self.net(torch.cat([features, action], dim=-1))


class NoiselessTanhNormal:
    """A distribution whose draws are its tanh mean and whose log-probability is a formula.

    So the arithmetic below needs no random numbers.
    """

    def __init__(self, loc, scale):
        self.loc, self.scale = loc, scale

    def rsample(self, shape=()):
        return self.loc.tanh()

    def log_prob(self, action):
        return (action.sum(dim=-1) + self.scale.log().sum(dim=-1)) / 2


def make(
    distribution=NoiselessTanhNormal, seed=0, policy=None, kind=SACfDLoss, critics=2, **settings
):
    torch.manual_seed(seed)
    observation = [keys.DEPTH, keys.HOLDING]
    network = TensorDictModule(policy or LinearPolicy(), observation, ["loc", "scale"])
    head = ProbabilisticTensorDictModule(
        in_keys=["loc", "scale"],
        out_keys=[keys.ACTION],
        distribution_class=distribution,
    )
    loss = kind(
        ProbabilisticTensorDictSequential(network, head),
        TensorDictModule(LinearEncoder(), observation, ["features"]),
        TensorDictModule(LinearCritics(critics), ["features", keys.ACTION], ["state_action_value"]),
        **settings,
    )
    loss.double()
    SoftUpdate(loss, tau=0.01)
    with torch.no_grad():  # targets that differ from the online networks
        for name in ("target_encoder_network_params", "target_qvalue_network_params"):
            for value in getattr(loss, name).values(True, True):
                value.mul_(0.7)
    return loss


def batch(experts=(True, False, True, False), weights=(0.2, 0.8, 0.4, 0.1)):
    """Four transitions: running, terminated, truncated, terminated by success."""
    generator = torch.Generator().manual_seed(7)

    def rand(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64) * 2 - 1

    def flag(*values):
        return torch.tensor(values)[:, None]

    terminated, truncated = flag(False, True, False, True), flag(False, False, True, False)
    data = {
        keys.DEPTH: rand(4, 2),
        keys.HOLDING: flag(True, False, False, True),
        keys.ACTION: rand(4, 2),
        keys.NEXT: {
            keys.DEPTH: rand(4, 2),
            keys.HOLDING: flag(False, False, True, True),
            keys.REWARD: torch.tensor([[0.0], [0.0], [0.5], [1.0]], dtype=torch.float64),
            keys.TERMINATED: terminated,
            keys.TRUNCATED: truncated,
            keys.DONE: terminated | truncated,
        },
    }
    if experts is not None:
        data[keys.IS_DEMONSTRATION] = flag(*experts)
    if weights is not None:
        data["priority_weight"] = torch.tensor(weights, dtype=torch.float64)
    return TensorDict(data, [4])
