"""A network: an actor-critic that sees the scene from above and from the wrist."""

from typing import ClassVar

import torch
from torch import nn

from ba_torchrl.modules.base import NETWORKS, ActorCritic, NetworkConfig


class Features(nn.Module):
    """(depth, wrist, holding) -> features [..., F], for any leading batch shape."""

    def __init__(self, width):
        super().__init__()
        self.views = nn.ModuleList(
            nn.Sequential(nn.Conv2d(1, width, 5, 4), nn.ReLU(), nn.AdaptiveAvgPool2d(4))
            for _ in range(2)
        )
        self.size = 2 * 16 * width + 1

    def forward(self, depth, wrist, holding):
        """Return the features of both views, and the holding flag."""
        batch = depth.shape[:-3]
        seen = [
            view(image.flatten(0, -4) if batch else image[None]).reshape(*batch, -1)
            for view, image in zip(self.views, (depth, wrist), strict=True)
        ]
        return torch.cat([*seen, holding.float()], dim=-1)


class Actor(nn.Module):
    """(depth, wrist, holding) -> mean and scale [..., A]."""

    def __init__(self, width, action_size):
        super().__init__()
        self.features = Features(width)
        self.head = nn.Linear(self.features.size, 2 * action_size)

    def forward(self, *images):
        """Return mean and scale of the Gaussian before it is squashed."""
        loc, log_scale = self.head(self.features(*images)).chunk(2, dim=-1)
        return loc, log_scale.clamp(-5, 2).exp()


class Critic(nn.Module):
    """(features, action) -> twin values [..., 2]."""

    def __init__(self, feature_size, action_size):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(feature_size + action_size, 32), nn.ReLU(), nn.Linear(32, 2)
        )

    def forward(self, features, action):
        """Return the values of both critics."""
        return self.layers(torch.cat([features, action], dim=-1))


@NETWORKS.register("mine/two_views")
class TwoViewsConfig(NetworkConfig):
    """Hyper-parameters of the network."""

    control: ClassVar[str] = "close_loop"
    image_keys: ClassVar[tuple[str, ...]] = ("depth", "wrist")
    vector_keys: ClassVar[tuple[str, ...]] = ()
    width: int = 4

    def build(self, spec):
        """Return freshly initialised modules."""
        encoder = Features(self.width)
        return ActorCritic(
            Actor(self.width, spec.action_size), encoder, Critic(encoder.size, spec.action_size)
        )
