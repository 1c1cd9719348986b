"""The actor-critic of FERM: small normalised features and wide heads (appendix G.2).

The architecture is the reference implementation's; the appendix does not give it.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor, nn

from ba_torchrl.modules.actor_critic.cnn import plain_trunk
from ba_torchrl.modules.actor_critic.trunk import ImageNetworkConfig, ImageTrunk, scale_from_log_std
from ba_torchrl.modules.base import NETWORKS, ActorCritic, ActorCriticSpec
from ba_torchrl.modules.layers import initialise_plain, scaled_width

_WIDTHS = (16, 32, 64, 128, 256, 256, 1024)
_HIDDEN = 1024


class FERMEncoder(nn.Module):
    """Normalised features of an image.

    Args:
        trunk: the image trunk.
        width: size of the trunk's output.
        features: size of the features.
    """

    def __init__(self, trunk: ImageTrunk, width: int, features: int) -> None:
        super().__init__()
        self.trunk = trunk
        self.head = nn.Sequential(nn.Linear(width, features), nn.LayerNorm(features))

    def forward(self, pixels: Tensor, holding: Tensor) -> Tensor:
        """Return features [..., F] of pixels [..., C, H, W] and holding [..., 1]."""
        return self.head(self.trunk(pixels, holding))


class FERMActor(nn.Module):
    """Gaussian policy on the convolutions of the critics' encoder.

    The losses of actors and critics take the shared parameters as constants in the actor's terms;
    behaviour cloning trains them.

    Args:
        trunk: the encoder's trunk, shared with it.
        width: size of the trunk's output.
        features: size of the policy's own features.
        action_size: number of action components.
        hidden: width of the hidden layers.
    """

    def __init__(
        self, trunk: ImageTrunk, width: int, features: int, action_size: int, hidden: int
    ) -> None:
        super().__init__()
        self.trunk = trunk
        self.head = nn.Sequential(nn.Linear(width, features), nn.LayerNorm(features))
        self.loc, self.log_std = (_mlp(features, hidden, action_size) for _ in range(2))

    def forward(self, pixels: Tensor, holding: Tensor) -> tuple[Tensor, Tensor]:
        """Return (loc, scale), each [..., A], of pixels [..., C, H, W] and holding [..., 1]."""
        features = self.head(self.trunk(pixels, holding))
        return self.loc(features), scale_from_log_std(self.log_std(features))


class FERMTwinCritic(nn.Module):
    """Two value heads on shared features.

    Args:
        features: size of the features.
        action_size: number of action components.
        hidden: width of the hidden layers.
    """

    def __init__(self, features: int, action_size: int, hidden: int) -> None:
        super().__init__()
        self.heads = nn.ModuleList(_mlp(features + action_size, hidden, 1) for _ in range(2))

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Return twin values [..., 2] of features [..., F] and action [..., A]."""
        x = torch.cat([features, action], dim=-1)
        return torch.cat([head(x) for head in self.heads], dim=-1)


def _mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden),
        nn.ReLU(),
        nn.Linear(hidden, hidden),
        nn.ReLU(),
        nn.Linear(hidden, outputs),
    )


@NETWORKS.register("ferm")
class FERMConfig(ImageNetworkConfig):
    """Hyper-parameters of the actor-critic of FERM.

    Args:
        width: factor on the width of convolutions and hidden layers; 1 is the reference's size.
        features: size of the encoder's features, on which the contrastive loss acts.
    """

    shares_encoder: ClassVar[bool] = True
    width: float = Field(default=1.0, gt=0)
    features: int = Field(default=50, ge=1)

    def build(self, spec: ActorCriticSpec) -> ActorCritic:
        """Return freshly initialised modules; actor and encoder share the trunk.

        Args:
            spec: the images and the action.

        Raises:
            ValueError: the image size is not 64 or 128, or the image is not depth or height.
        """
        self.check_images(spec)
        widths = [scaled_width(width, self.width) for width in _WIDTHS]
        hidden = scaled_width(_HIDDEN, self.width)
        trunk = plain_trunk(self, spec, widths)
        networks = ActorCritic(
            actor=FERMActor(trunk, widths[-1], self.features, spec.action_size, hidden),
            encoder=FERMEncoder(trunk, widths[-1], self.features),
            critic=FERMTwinCritic(self.features, spec.action_size, hidden),
        )
        for network in networks:
            network.apply(initialise_plain)
        return networks
