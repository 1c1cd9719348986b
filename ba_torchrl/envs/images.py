"""ImageSpec: everything that is declared about an image that an environment observes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torchrl.data import Bounded

Storage = Literal["uint8", "float16", "exact"]
"""How the replay stores an image: 255 equal steps over its range, half precision, or unchanged."""
Frame = Literal["scene", "gripper", "camera"]
"""Which axes an image has: the scene's (rows +x, columns +y), the gripper's, or those of a camera
that stands elsewhere, for which no transformation is defined."""


@dataclass(frozen=True)
class ImageSpec:
    """Shape, values, storage and axes of an image.

    The replay, demonstrations, augmentation, policies and networks read them from here.

    Args:
        channels: number of channels.
        size: rows and columns, pixels.
        high: largest value.
        low: smallest value.
        storage: how the replay stores it.
        frame: "scene" images turn with the scene, "gripper" images stay when the scene turns and
            are reversed when the gripper's axes are, "camera" images cannot be augmented.
        channel_axes: of a "gripper" image: the gripper's axes along rows and columns of each
            channel; empty for "xy" in every channel.
        dtype: of the values.
    """

    channels: int
    size: int
    high: float
    low: float = 0.0
    storage: Storage = "float16"
    frame: Frame = "scene"
    channel_axes: tuple[str, ...] = ()
    dtype: torch.dtype = torch.float32

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
        return Bounded(self.low, self.high, shape=self.shape, dtype=self.dtype)
