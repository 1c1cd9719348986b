"""ImageSpec: the declaration of an image that an environment observes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torchrl.data import Bounded

from ba_torchrl.core.config import numbers_of
from ba_torchrl.core.errors import ConfigError, check_choice

Storage = Literal["uint8", "float16", "exact"]
"""Type of an image in the replay: 255 equal steps over its range, half precision, or unchanged."""
Frame = Literal["scene", "gripper", "camera"]
"""Axes of an image: the scene's (rows +x, columns +y), the gripper's, or those of a camera that is
fixed or turns with the tool, for which no augmentation is defined."""


@dataclass(frozen=True)
class ImageSpec:
    """Shape, values, storage and axes of an image.

    The replay, demonstrations, augmentation, policies and networks use these declarations.

    Args:
        channels: number of channels.
        size: rows and columns, pixels.
        high: largest value.
        low: smallest value.
        storage: type of the image in the replay.
        frame: "scene" images rotate with the scene; "gripper" images are invariant under rotations
            of the scene and are reversed with the gripper's axes; "camera" images cannot be
            augmented.
        channel_axes: for "gripper" images, the gripper's axes along rows and columns of each
            channel; empty for "xy" in every channel.
        dtype: of the values.
        max_zeros: largest share of values of 0 that the environment draws. More of them are pixels
            without a return of a real camera.
    """

    channels: int
    size: int
    high: float
    low: float = 0.0
    storage: Storage = "float16"
    frame: Frame = "scene"
    channel_axes: tuple[str, ...] = ()
    dtype: torch.dtype = torch.float32
    max_zeros: float = 1.0

    def __post_init__(self) -> None:
        check_choice("storage", self.storage, Storage)
        check_choice("frame", self.frame, Frame)
        given, what = (self.low, self.high), "finite numbers low < high"
        try:
            low, high = numbers_of(given, what)
        except ValueError as error:
            raise ConfigError(f"range of an image: {error}, not {given}") from None
        if not -math.inf < low < high < math.inf:
            raise ConfigError(f"range of an image: must be {what}, not {given}")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Channels, rows and columns."""
        return self.channels, self.size, self.size

    @property
    def axes(self) -> tuple[str, ...]:
        """The gripper's axes along rows and columns of each channel."""
        return self.channel_axes or ("xy",) * self.channels

    def to_tensor_spec(self) -> Bounded:
        """Return the image's TorchRL specification."""
        return Bounded(self.low, self.high, self.shape, device="cpu", dtype=self.dtype)

    def reverse_axes(self, images: Tensor, axes: str) -> Tensor:
        """Return images in the gripper's axes with some of these axes reversed.

        Exact for heights. Projections are accurate to one voxel, because their smoothing is not
        symmetric.

        Args:
            images: [B, C, h, w].
            axes: "x", along which the fingers close, "y", perpendicular to it, or both.
        """
        channels = [
            channel.flip([dim for dim in (-2, -1) if names[dim] in axes])
            for channel, names in zip(images.unbind(1), self.axes, strict=True)
        ]
        return torch.stack(channels, dim=1)
