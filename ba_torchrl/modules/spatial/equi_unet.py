"""The equivariant UNet and its Q values of every pixel; the in-hand image enters as a filter."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.modules.layers import scaled_width
from ba_torchrl.modules.spatial.base import (
    SpatialSpec,
    dense_width,
    scaled_heights,
    scaled_in_hand,
)
from ba_torchrl.modules.spatial.in_hand import InHandVector
from ba_torchrl.modules.spatial.spatial_config import SpatialImageConfig
from ba_torchrl.modules.spatial.unet import ResidualBlock, UNet
from ba_torchrl.modules.steerable.layers import (
    DynamicSteerableConv2d,
    FieldTypes,
    FilterGenerator,
    SteerableConv2d,
)
from ba_torchrl.modules.steerable.planar import PlanarGroup, Representation

_FIELDS = (16, 32, 64, 128, 128)


def _block(group: PlanarGroup, fields: int, width: int) -> ResidualBlock:
    """Return a residual block of regular fields, with a 3x3 shortcut (1x1 in the plain block)."""
    regular = group.regular_repr
    inputs, outputs = [(regular, fields)], [(regular, width)]

    def conv(types: FieldTypes) -> SteerableConv2d:
        return SteerableConv2d(types, outputs, 3, padding=1)

    return ResidualBlock(conv(inputs), conv(outputs), None if fields == width else conv(inputs))


def equivariant_unet(group: PlanarGroup, fields: Sequence[int]) -> UNet:
    """Return a UNet from one invariant channel to fields[0] regular fields.

    Args:
        fields: numbers of regular fields of the five scales, from fine to coarse.
    """
    f1, f2, f4, f8, f16 = fields
    lift = SteerableConv2d([(group.trivial_repr, 1)], [(group.regular_repr, f1)], 3, padding=1)
    encoders = [nn.Sequential(lift, nn.ReLU(inplace=True), _block(group, f1, f1))]
    encoders += [_block(group, a, b) for a, b in ((f1, f2), (f2, f4), (f4, f8), (f8, f16))]
    inputs, outputs = (f16 + f8, 2 * f4, 2 * f2, 2 * f1), (f4, f2, f1, f1)
    return UNet(encoders, [_block(group, a, b) for a, b in zip(inputs, outputs, strict=True)])


class _Head(nn.Module):
    """Regular fields to values: a hidden 3x3 layer for invariant values, then a 1x1 layer.

    The hidden layer keeps its full width in narrow networks. With four units, one head in sixteen
    would be initialised with negative output weights only, and no value would exceed its bias.

    Args:
        out_repr: representation of the values; there is a hidden layer only for invariant values.
    """

    def __init__(self, fields: int, out_repr: Representation) -> None:
        super().__init__()
        group = out_repr.group
        types: FieldTypes = [(group.regular_repr, fields)]
        self.hidden = None
        if out_repr.is_trivial():
            hidden = [(group.trivial_repr, max(fields, _FIELDS[0]))]
            self.hidden = SteerableConv2d(types, hidden, 3, padding=1)
            types = hidden
        self.values = SteerableConv2d(types, [(out_repr, 1)], 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return float32 values [B, out, H, W] of x [B, C, H, W]."""
        if self.hidden is not None:
            x = F.relu(self.hidden(x), inplace=True)
        # bfloat16 would round values near one to multiples of 1/256, so many pixels would share the
        # maximum.
        return self.values(x.float())


class EquivariantPixelValues(nn.Module):
    """Q values of every pixel, equivariant; values of places also depend on the in-hand image.

    Args:
        out_repr: how the values of one pixel transform: the trivial representation for a single
            value, a representation on yaws for one value per yaw.
    """

    def __init__(
        self,
        out_repr: Representation,
        spec: SpatialSpec,
        config: SpatialImageConfig,
    ) -> None:
        super().__init__()
        self.config = config
        fields = [scaled_width(f, config.width) for f in _FIELDS]
        regular = out_repr.group.regular_repr
        self._group_size = regular.size
        self.scene_channels = fields[-1]
        wide = dense_width(config, 1024)
        self.hand = InHandVector(spec.in_hand_channels, spec.in_hand_size, config.width, wide)
        self.hand.reset_parameters()
        self.unet = equivariant_unet(out_repr.group, fields)
        self.held = DynamicSteerableConv2d(regular, fields[0], 3)
        self.coefficients = FilterGenerator(self.hand.out_features, self.held)
        self.pick = _Head(fields[0], out_repr)
        self.place = _Head(fields[0], out_repr)

    def forward(self, heightmap: Tensor, in_hand: Tensor, holding: Tensor) -> tuple[Tensor, Tensor]:
        """Return values and the invariant bottleneck map.

        Args:
            heightmap: heightmaps [B, 1, H, W].
            in_hand: [B, C, h, w]; used for the samples in which an object is held.
            holding: [B, 1].

        Returns:
            float32 [B, out, H, W], and [B, scene_channels, H/16, W/16] of invariant channels, whose
            positions rotate with the image.
        """
        is_holding = holding.reshape(-1).bool()
        if holding.device.type == "cpu" and not torch.compiler.is_compiling():
            return self._sorted_values(heightmap, in_hand, is_holding)
        return self._selected_values(heightmap, in_hand, is_holding)

    def _fields(self, heightmap: Tensor) -> tuple[Tensor, Tensor]:
        """Return the regular fields of every pixel and the invariant bottleneck map."""
        maps = self.unet.encode(scaled_heights(self.config, heightmap))
        return self.unet.decode(maps), maps[-1].unflatten(1, (-1, self._group_size)).amax(dim=2)

    def _place_values(self, fields: Tensor, in_hand: Tensor) -> Tensor:
        coefficients = self.coefficients(self.hand(scaled_in_hand(self.config, in_hand)))
        return self.place(F.relu(self.held(fields, coefficients)))

    def _sorted_values(
        self, heightmap: Tensor, in_hand: Tensor, is_holding: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return `forward`'s result, with one head for each sample.

        Samples with an empty gripper come first, so each head gets a slice and no large map is
        copied. The host reads how many they are.
        """
        order = is_holding.long().argsort(stable=True)
        full = int(is_holding.sum())
        parts = [len(order) - full, full]
        fields, scene = self._fields(heightmap[order])
        opened, filled = fields.split(parts)
        places = self._place_values(filled, in_hand[order[parts[0] :]])
        restore = order.argsort()
        return torch.cat([self.pick(opened), places])[restore], scene[restore]

    def _selected_values(
        self, heightmap: Tensor, in_hand: Tensor, is_holding: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return `forward`'s result, with both heads for each sample.

        Shapes do not depend on the data, and the host reads no result.
        """
        fields, scene = self._fields(heightmap)
        places = self._place_values(fields, in_hand)
        values = torch.where(is_holding[:, None, None, None], places, self.pick(fields))
        return values, scene
