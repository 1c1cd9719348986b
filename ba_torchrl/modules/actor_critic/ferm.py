"""The actor-critic of FERM: small normalised features and wide heads (appendix G.2).

The architecture is the reference implementation's; the appendix does not give it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ba_torchrl.modules.actor_critic.cnn import PlainActor, PlainTwinCritic, mlp, plain_trunk
from ba_torchrl.modules.actor_critic.ferm_config import FERMConfig
from ba_torchrl.modules.actor_critic.trunk import ImageTrunk
from ba_torchrl.modules.base import ActorCritic, ActorCriticSpec, Frames
from ba_torchrl.modules.layers import XavierInitialised, scaled_width

_WIDTHS = (16, 32, 64, 128, 256, 256, 1024)
_HIDDEN = 1024


class FERMEncoder(XavierInitialised):
    """Normalised features of an image."""

    def __init__(self, trunk: ImageTrunk, width: int, features: int) -> None:
        super().__init__()
        self.trunk = trunk
        self.head = _normalised(width, features)

    def forward(self, depth: Tensor, holding: Tensor, *vectors: Tensor) -> Tensor:
        """Return features [..., F] of depth [..., C, H, W] and holding [..., 1], then vectors."""
        features = self.head(self.trunk(depth, holding))
        return torch.cat([features, *vectors], dim=-1) if vectors else features


def _normalised(width: int, features: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(width, features), nn.LayerNorm(features))


def build_ferm(config: FERMConfig, spec: ActorCriticSpec) -> ActorCritic:
    """Return freshly initialised modules; actor and encoder share the trunk."""
    config.check_images(spec)
    widths = [scaled_width(width, config.width) for width in _WIDTHS]
    width, hidden, size = widths[-1], scaled_width(_HIDDEN, config.width), spec.action_size
    trunk = plain_trunk(config, spec, widths)
    head = _normalised(width, config.features)
    features = config.features + spec.vector_size
    loc, log_std = (mlp(features, hidden, hidden, size) for _ in range(2))
    networks = ActorCritic(
        actor=PlainActor(trunk, head, loc, log_std),
        encoder=FERMEncoder(trunk, width, config.features),
        critic=PlainTwinCritic(mlp(features + size, hidden, hidden, 1) for _ in range(2)),
        frames=Frames.without_symmetry(spec),
    )
    for network in networks:
        network.reset_parameters()
    return networks
