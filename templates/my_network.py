"""An actor-critic for close-loop tasks whose features are points in the scene (spatial softmax)."""

from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import nn

from ba_torchrl.modules.base import NETWORKS, ActorCritic, NetworkConfig


class Features(nn.Module):
    """(depth [..., C, H, W], holding [..., 1], vectors [..., V]) -> features [..., F]."""

    def __init__(self, spec, config):
        super().__init__()
        self.config, width = config, config.width
        self.maps = nn.Sequential(
            *[nn.Conv2d(spec.image_channels, width, 5, 2, 2), nn.ReLU()],
            *[nn.Conv2d(width, width, 3, 2, 1), nn.ReLU(), nn.Conv2d(width, width, 3, 1, 1)],
        )
        self.size = 3 * width + 1 + spec.vector_size

    def forward(self, depth, *others):
        """Return the mean row, column and depth of each feature map's softmax, and the others."""
        batch = depth.shape[:-3]
        depth = (depth - self.config.depth_center_m) / self.config.depth_scale_m
        depth = depth.reshape(batch.numel(), *depth.shape[-3:])
        maps = self.maps(depth)
        weights = (maps.flatten(2) / self.config.temperature).softmax(-1).reshape(maps.shape)
        axis = torch.linspace(-1, 1, maps.shape[-1], device=maps.device)
        depths = F.adaptive_avg_pool2d(depth[:, :1], maps.shape[-2:])
        means = [weights.sum(3) @ axis, weights.sum(2) @ axis, (weights * depths).sum((2, 3))]
        points = torch.cat(means, -1).reshape(*batch, -1)
        return torch.cat([points, *(other.float() for other in others)], -1)


def perceptron(inputs, outputs, hidden):
    """Return two hidden layers and a linear one."""
    layers = [nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(hidden, outputs))


class Actor(nn.Module):
    """(depth, holding, vectors) -> mean and scale [..., A] of a Gaussian, squashed later."""

    def __init__(self, spec, config):
        super().__init__()
        self.features = Features(spec, config)
        self.head = perceptron(self.features.size, 2 * spec.action_size, config.hidden)

    def forward(self, *observation):
        """Return mean and scale."""
        loc, log_scale = self.head(self.features(*observation)).chunk(2, -1)
        return loc, log_scale.clamp(-5, 2).exp()


class Critic(nn.Module):
    """(features [..., F], action [..., A]) -> the values of two critics [..., 2]."""

    def __init__(self, features, action_size, hidden):
        super().__init__()
        self.heads = nn.ModuleList(perceptron(features + action_size, 1, hidden) for _ in range(2))

    def forward(self, features, action):
        """Return the values."""
        inputs = torch.cat([features, action], -1)
        return torch.cat([head(inputs) for head in self.heads], -1)


@NETWORKS.register("mine/my_network")
class MyNetworkConfig(NetworkConfig):
    """Hyper-parameters, which the command line sets: ``network.width=64``."""

    control: ClassVar[str] = "close_loop"
    image_keys: ClassVar[tuple[str, ...]] = ("depth",)
    vector_keys: tuple[str, ...] = ()
    width: int = 32
    """Feature maps."""
    hidden: int = 128
    temperature: float = 0.1
    """Of the softmax: small values attend to one place."""
    depth_center_m: float = 0.2
    depth_scale_m: float = 0.1

    def build(self, spec):
        """Return freshly initialised modules for an `ActorCriticSpec`."""
        encoder = Features(spec, self)
        critic = Critic(encoder.size, spec.action_size, self.hidden)
        return ActorCritic(Actor(spec, self), encoder, critic)
