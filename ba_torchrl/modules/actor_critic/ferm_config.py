"""Hyper-parameters of the actor-critic of FERM."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from ba_torchrl.modules.actor_critic.image_config import ImageNetworkConfig
from ba_torchrl.modules.config import MAX_WIDTH, NETWORKS


@NETWORKS.register("ferm")
class FERMConfig(ImageNetworkConfig):
    """Hyper-parameters of the actor-critic of FERM.

    The policy uses the convolutions of the critics' encoder, and has its own features. The losses
    of actors and critics take the shared parameters as constants in the actor's terms; behaviour
    cloning trains them.

    Args:
        width: factor on the width of convolutions and hidden layers; 1 is the reference's size.
        features: size of the encoder's features of the image, on which the contrastive loss acts.
    """

    builder: ClassVar[str] = "ba_torchrl.modules.actor_critic.ferm:build_ferm"

    shares_encoder: ClassVar[bool] = True
    width: float = Field(default=1.0, gt=0, le=MAX_WIDTH)
    features: int = Field(default=50, ge=1, le=4096)
