"""The plain convolutional actor-critic (appendix G.2; "CNN SACfD")."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn

from ba_torchrl.modules.actor_critic.cnn_config import CNNConfig
from ba_torchrl.modules.actor_critic.critics import EnsembleCritic
from ba_torchrl.modules.actor_critic.image_config import ImageNetworkConfig
from ba_torchrl.modules.actor_critic.trunk import ImageTrunk, scale_from_log_std, trunk_stages
from ba_torchrl.modules.base import ActorCritic, ActorCriticSpec, Frames
from ba_torchrl.modules.layers import CastConv2d, XavierInitialised, scaled_width

_WIDTHS = (16, 32, 64, 128, 256, 256, 128)
_HIDDEN = 128


class PlainActor(XavierInitialised):
    """Gaussian policy: an image trunk, and one network each for mean and log-std.

    Args:
        head: from the encoder's features to the policy's.
        loc: from these to the mean, before the squashing.
        log_std: from these to the log standard deviation.
    """

    def __init__(
        self, trunk: ImageTrunk, head: nn.Module, loc: nn.Module, log_std: nn.Module
    ) -> None:
        super().__init__()
        self.trunk = trunk
        self.head = head
        self.loc = loc
        self.log_std = log_std

    def forward(self, depth: Tensor, holding: Tensor, *vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Return (loc, scale), each [..., A], of depth [..., C, H, W], holding [..., 1] and
        vectors, which are appended to the features of the policy."""
        features = self.head(self.trunk(depth, holding))
        features = torch.cat([features, *vectors], dim=-1) if vectors else features
        return self.loc(features), scale_from_log_std(self.log_std(features))


class PlainTwinCritic(XavierInitialised):
    """Two value heads on shared features.

    Args:
        heads: from features and action to one value each.
    """

    def __init__(self, heads: Iterable[nn.Module]) -> None:
        super().__init__()
        self.heads = nn.ModuleList(heads)

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Return twin values [..., 2] of features [..., F] and action [..., A]."""
        x = torch.cat([features, action], dim=-1)
        return torch.cat([head(x) for head in self.heads], dim=-1)


def mlp(*sizes: int) -> nn.Sequential:
    """Return linear layers between these sizes, with ReLUs between them."""
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def plain_trunk(
    config: ImageNetworkConfig, spec: ActorCriticSpec, widths: Sequence[int]
) -> ImageTrunk:
    """Return a trunk of plain convolutions with the widths of the stages of 128 px images."""
    stages = trunk_stages(spec.image_size, widths)
    inputs = [config.input_channels(spec.image_channels), *(width for width, _, _ in stages)]
    convs = [
        CastConv2d(channels, width, 3, padding=padding)
        for channels, (width, padding, _) in zip(inputs, stages, strict=False)
    ]
    return ImageTrunk(convs, [pools for _, _, pools in stages], config, spec.image_shape)


def build_cnn(config: CNNConfig, spec: ActorCriticSpec) -> ActorCritic:
    """Return freshly initialised modules."""
    config.check_images(spec)
    features = scaled_width(_WIDTHS[-1], config.width) + spec.vector_size
    trunk = _trunk(config, spec)
    loc, log_std = (nn.Linear(features, spec.action_size) for _ in range(2))
    networks = ActorCritic(
        actor=PlainActor(trunk, nn.Identity(), loc, log_std),
        encoder=_trunk(config, spec),
        critic=_critic(config, spec, features),
        frames=Frames.without_symmetry(spec),
    )
    for network in networks:
        network.reset_parameters()
    return networks


def _critic(config: CNNConfig, spec: ActorCriticSpec, features: int) -> nn.Module:
    hidden = scaled_width(_HIDDEN, config.width)
    if spec.critics is None:
        return PlainTwinCritic(mlp(features + spec.action_size, hidden, 1) for _ in range(2))
    first = nn.Linear(features + spec.action_size, spec.critics * hidden)
    return EnsembleCritic(first, spec.critics, hidden)


def _trunk(config: CNNConfig, spec: ActorCriticSpec) -> ImageTrunk:
    return plain_trunk(config, spec, [scaled_width(width, config.width) for width in _WIDTHS])
