"""Plain convolutional encoders of the in-hand image and of patches of the same size."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.modules.layers import CastConv2d, XavierInitialised, scaled_width
from ba_torchrl.modules.steerable.max_pool import relu_of_max_pool

_LARGEST_LAST_MAP = 6


class InHandMap(nn.Module):
    """A feature map of a small image: three unpadded 3x3 convolutions and a pool, 24 -> 8 pixels.

    Args:
        width: factor on the layers' widths, 64, 128 and 256.
    """

    def __init__(self, channels: int, size: int, width: float) -> None:
        super().__init__()
        self.out_size = (size - 4) // 2 - 2
        if self.out_size < 1:
            raise ValueError(f"this network needs an in_hand_size of at least 10, got {size}")
        first, second, self.out_channels = (scaled_width(w, width) for w in (64, 128, 256))
        self.first = CastConv2d(channels, first, 3)
        self.second = CastConv2d(first, second, 3)
        self.third = CastConv2d(second, self.out_channels, 3)

    def forward(self, images: Tensor) -> Tensor:
        """Return [B, out_channels, out_size, out_size] of images [B, C, h, h], in their dtype."""
        x = F.relu(self.first(images), inplace=True)
        x = relu_of_max_pool(self.second(x))
        return F.relu(self.third(x), inplace=True)


class InHandVector(XavierInitialised):
    """A feature vector of a small image: four padded 3x3 convolutions, pools and a linear layer.

    There are two pools for images of 24 pixels and three for 40 pixels.

    Args:
        width: factor on the convolutions' widths, 32, 64, 128 and 256.
        out_features: width of the linear layer.
    """

    def __init__(self, channels: int, size: int, width: float, out_features: int) -> None:
        super().__init__()
        pools = 2 if size // 4 <= _LARGEST_LAST_MAP else 3
        last = size >> pools
        if not 1 <= last <= _LARGEST_LAST_MAP:
            raise ValueError(f"this network needs an in_hand_size from 4 to 55, got {size}")
        widths = [scaled_width(w, width) for w in (32, 64, 128, 256)]
        self.convs = nn.ModuleList(
            CastConv2d(a, b, 3, padding=1)
            for a, b in zip([channels, *widths[:-1]], widths, strict=True)
        )
        self.pools = (pools == 3, True, True, False)
        self.out_features = out_features
        self.linear = nn.Linear(widths[-1] * last * last, out_features)

    def forward(self, images: Tensor) -> Tensor:
        """Return float32 features [B, out_features] of images [B, C, h, h]."""
        x = images
        for conv, pool in zip(self.convs, self.pools, strict=True):
            x = conv(x)
            x = relu_of_max_pool(x) if pool else F.relu(x, inplace=True)
        return F.relu(self.linear(x.flatten(1).float()), inplace=True)
