"""A network and an algorithm as a user writes them."""

from typing import ClassVar

import torch
from torch import nn

from ba_torchrl.algorithms.base import ALGORITHMS
from ba_torchrl.algorithms.sac import SACConfig
from ba_torchrl.modules.base import NETWORKS, ActorCritic, NetworkConfig


class FlatActor(nn.Module):
    """One linear layer on the image."""

    def __init__(self, image_size: int, action_size: int) -> None:
        super().__init__()
        self.layer = nn.Linear(image_size**2 + 1, 2 * action_size)

    def forward(self, depth, holding):
        loc, log_std = self.layer(flat(depth, holding)).chunk(2, dim=-1)
        return loc, log_std.clamp(-5, 2).exp()


class FlatEncoder(nn.Module):
    def forward(self, depth, holding):
        return flat(depth, holding)


class FlatCritic(nn.Module):
    def __init__(self, image_size: int, action_size: int, hidden: int) -> None:
        super().__init__()
        size = image_size**2 + 1 + action_size
        self.layers = nn.Sequential(nn.Linear(size, hidden), nn.ReLU(), nn.Linear(hidden, 2))

    def forward(self, features, action):
        return self.layers(torch.cat([features, action], dim=-1))


def flat(depth, holding):
    return torch.cat([depth.flatten(-3), holding.float()], dim=-1)


@NETWORKS.register("mine/flat")
class FlatConfig(NetworkConfig):
    """Hyper-parameters of the linear actor-critic."""

    control: ClassVar[str] = "close_loop"
    image_keys: ClassVar[tuple[str, ...]] = ("depth",)
    vector_keys: tuple[str, ...] = ()
    hidden: int = 8

    def build(self, spec):
        return ActorCritic(
            FlatActor(spec.image_size, spec.action_size),
            FlatEncoder(),
            FlatCritic(spec.image_size, spec.action_size, self.hidden),
        )


@ALGORITHMS.register("mine/sac")
class MySACConfig(SACConfig):
    """SAC with another discount factor."""

    gamma: float = 0.9
