"""Hyper-parameters of the plain convolutional actor-critic."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from ba_torchrl.modules.actor_critic.image_config import ImageNetworkConfig
from ba_torchrl.modules.config import MAX_WIDTH, NETWORKS


@NETWORKS.register("cnn")
class CNNConfig(ImageNetworkConfig):
    """Hyper-parameters of the plain convolutional actor-critic.

    Args:
        width: factor on every layer's width; 1 is the reference's size.
    """

    builder: ClassVar[str] = "ba_torchrl.modules.actor_critic.cnn:build_cnn"

    width: float = Field(default=1.0, gt=0, le=MAX_WIDTH)
