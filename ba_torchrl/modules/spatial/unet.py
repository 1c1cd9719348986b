"""UNets, and the plain UNet whose bottleneck map is fused with in-hand features."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.modules.layers import CastConv2d, XavierInitialised, scaled_width
from ba_torchrl.modules.spatial.base import (
    SpatialSpec,
    scaled_heights,
    scaled_in_hand,
    select_primitive,
)
from ba_torchrl.modules.spatial.in_hand import InHandMap
from ba_torchrl.modules.spatial.spatial_config import SpatialImageConfig

_WIDTHS = (32, 64, 128, 256, 512)


class UNet(nn.Module):
    """Encoders from fine to coarse maps and decoders back, joined by skip connections.

    Args:
        encoders: one per scale, from fine to coarse; a 2x2 max pool precedes each but the first.
        decoders: one per scale, from the second coarsest to the finest; the input of each is the
            previous map, upsampled by two, and the encoder's map of its scale.
    """

    def __init__(self, encoders: Iterable[nn.Module], decoders: Iterable[nn.Module]) -> None:
        super().__init__()
        self.encoders = nn.ModuleList(encoders)
        self.decoders = nn.ModuleList(decoders)

    def encode(self, x: Tensor) -> list[Tensor]:
        """Return the encoders' maps of x [B, C, H, W], from fine to coarse."""
        maps: list[Tensor] = []
        for encoder in self.encoders:
            maps.append(encoder(F.max_pool2d(maps[-1], 2) if maps else x))
        return maps

    def decode(self, maps: Sequence[Tensor]) -> Tensor:
        """Return the finest decoder's map [B, C, H, W] of the encoders' maps."""
        *skips, x = maps
        for decoder, skip in zip(self.decoders, reversed(skips), strict=True):
            # Without aligned corners, so that quarter turns of the image stay exact.
            doubled = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
            if doubled.requires_grad:
                # Its gradient is a slice of the concatenated map's gradient. On CPUs the backward
                # pass of the interpolation takes ten times as long for a slice as for a copy.
                doubled.register_hook(_channels_last)
            x = decoder(torch.cat([doubled, skip], dim=1))
        return x


def _channels_last(gradient: Tensor) -> Tensor:
    return gradient.contiguous(memory_format=torch.channels_last)


class ResidualBlock(nn.Module):
    """Two convolutions and a shortcut, with ReLUs after the first convolution and after the sum.

    Args:
        first: convolution to the new width.
        second: convolution that keeps it.
        shortcut: convolution to the new width; None for the identity.
    """

    def __init__(self, first: nn.Module, second: nn.Module, shortcut: nn.Module | None) -> None:
        super().__init__()
        self.first = first
        self.second = second
        self.shortcut = shortcut

    def forward(self, x: Tensor) -> Tensor:
        """Return the block's map of x [B, C, H, W]."""
        y = self.second(F.relu(self.first(x), inplace=True))
        # In place: no convolution needs its own output for its gradient.
        return F.relu(y.add_(x if self.shortcut is None else self.shortcut(x)), inplace=True)


def residual_block(channels: int, width: int) -> ResidualBlock:
    """Return a plain block from ``channels`` to ``width``: 3x3 without bias, 1x1 shortcut."""
    return ResidualBlock(
        CastConv2d(channels, width, 3, padding=1, bias=False),
        CastConv2d(width, width, 3, padding=1, bias=False),
        None if channels == width else CastConv2d(channels, width, 1, bias=False),
    )


class PlainPixelValues(XavierInitialised):
    """Q values of every pixel from a plain UNet on the heightmap and the in-hand image.

    Args:
        maps: values per pixel and primitive.
    """

    def __init__(self, spec: SpatialSpec, config: SpatialImageConfig, maps: int) -> None:
        super().__init__()
        self.config = config
        w1, w2, w4, w8, w16 = (scaled_width(w, config.width) for w in _WIDTHS)
        lift = CastConv2d(1, w1, 3, padding=1)
        self.unet = UNet(
            [
                nn.Sequential(lift, nn.ReLU(inplace=True), residual_block(w1, w1)),
                residual_block(w1, w2),
                residual_block(w2, w4),
                residual_block(w4, w8),
                nn.Sequential(residual_block(w8, w16), CastConv2d(w16, w8, 1)),
            ],
            [
                nn.Sequential(residual_block(2 * w8, w8), CastConv2d(w8, w4, 1)),
                nn.Sequential(residual_block(2 * w4, w4), CastConv2d(w4, w2, 1)),
                nn.Sequential(residual_block(2 * w2, w2), CastConv2d(w2, w1, 1)),
                residual_block(2 * w1, w1),
            ],
        )
        self.hand = InHandMap(spec.in_hand_channels, spec.in_hand_size, config.width)
        self.fuse = residual_block(w8 + self.hand.out_channels, w8)
        self.head = CastConv2d(w1, 2 * maps, 1)
        self.scene_channels = w8
        self.reset_parameters()

    def forward(self, heightmap: Tensor, in_hand: Tensor, holding: Tensor) -> tuple[Tensor, Tensor]:
        """Return values and the bottleneck map.

        Args:
            heightmap: n views of each of B [n*B, 1, H, W]; the index of the view is the outer one.
            in_hand: [B, C, h, w].
            holding: [B, 1], which picks the primitive.

        Returns:
            float32 [n*B, maps, H, W], and [n*B, scene_channels, H/16, W/16].
        """
        *skips, inner = self.unet.encode(scaled_heights(self.config, heightmap))
        hand = self.hand(scaled_in_hand(self.config, in_hand))
        if hand.shape[-2:] != inner.shape[-2:]:
            hand = F.interpolate(hand, inner.shape[-2:], mode="bilinear", align_corners=False)
        views = len(heightmap) // len(in_hand)
        fused = torch.cat([inner, hand.repeat(views, 1, 1, 1)], dim=1)
        scene = self.fuse(fused.contiguous(memory_format=torch.channels_last))
        # bfloat16 would round values near one to multiples of 1/256, so many pixels would share the
        # maximum.
        values = self.head(self.unet.decode([*skips, scene]).float())
        return select_primitive(values, holding.reshape(-1, 1).repeat(views, 1)), scene
