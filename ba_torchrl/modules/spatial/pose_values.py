"""Q values of one component of a pose from views of the scene (appendix D.2)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.core.images import ImageSpec
from ba_torchrl.modules.layers import CastConv2d, XavierInitialised, scaled_width
from ba_torchrl.modules.spatial.base import (
    UNET_STRIDE,
    SpatialSpec,
    dense_width,
    scaled_in_hand,
    select_primitive,
)
from ba_torchrl.modules.spatial.spatial_config import SpatialImageConfig
from ba_torchrl.modules.spatial.views import centre_fit
from ba_torchrl.modules.steerable.max_pool import relu_of_max_pool

_WIDTHS = (32, 64, 128, 128)
_POOLS = 3


def _convolve(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Return the padded 3x3 convolution of x [B, C, H, W] in its dtype."""
    bias = None if bias is None else bias.to(x.dtype)
    return F.conv2d(x, weight.to(x.dtype), bias, padding=1)


class SceneMapVector(nn.Module):
    """A vector of the scene feature map: a 3x3 convolution, a pool and two linear layers.

    Args:
        config: widths of the layers, 128, 1024 and 512 in the reference's size.
        copies: number of copies of each channel that the convolution sees.
    """

    def __init__(
        self, channels: int, image_size: int, config: SpatialImageConfig, copies: int = 1
    ) -> None:
        super().__init__()
        side = image_size // UNET_STRIDE // 2
        if side < 1:
            raise ValueError(
                f"six degrees of freedom need an obs_size of at least 32, got {image_size}"
            )
        inner = scaled_width(128, config.width)
        wide, self.out_features = (dense_width(config, w) for w in (1024, 512))
        self.copies = copies
        self.conv = CastConv2d(copies * channels, inner, 3, padding=1)
        self.first = nn.Linear(inner * side * side, wide)
        self.second = nn.Linear(wide, self.out_features)

    def forward(self, scene: Tensor) -> Tensor:
        """Return float32 [B, out_features] of a map [B, C, h, w]."""
        if self.copies > 1:
            scene = scene.repeat(1, self.copies, 1, 1)
        x = relu_of_max_pool(self.conv(scene))
        return self.second(F.relu(self.first(x.flatten(1).float())))


class PoseValues(XavierInitialised):
    """Q values from one or several views of the scene, the in-hand image and the scene features.

    Every view has its own values, by shared weights: with one view, the values of all choices; with
    one view per choice (deictic encoding), the value of that choice. The features of the in-hand
    image and of the scene are computed once per sample.

    Args:
        view_channels: 1 for heights, 3 for projections.
        values_per_view: values of each view and primitive.
        scene: from the scene feature map to a vector, with ``out_features``.
    """

    def __init__(
        self,
        spec: SpatialSpec,
        config: SpatialImageConfig,
        view_channels: int,
        values_per_view: int,
        patch_size: int,
        scene: nn.Module,
    ) -> None:
        super().__init__()
        last = patch_size >> _POOLS
        if last < 1:
            raise ValueError(f"patch_size must be at least {1 << _POOLS} pixels, got {patch_size}")
        self.config = config
        self.values_per_view = values_per_view
        widths = [scaled_width(w, config.width) for w in _WIDTHS]
        inputs = [view_channels + spec.in_hand_channels, *widths[:-1]]
        self.convs = nn.ModuleList(
            CastConv2d(a, b, 3, padding=1) for a, b in zip(inputs, widths, strict=True)
        )
        wide, narrow = dense_width(config, 1024), dense_width(config, 512)
        self.wide = nn.Linear(widths[-1] * last * last, wide)
        self.narrow = nn.Linear(wide, narrow)
        self.scene = scene
        self.values = nn.Linear(narrow + scene.out_features, 2 * values_per_view)
        self.reset_parameters()

    def forward(self, views: Tensor, in_hand: Tensor, scene: Tensor, holding: Tensor) -> Tensor:
        """Return values [B, K * values_per_view], the first view's first.

        Args:
            views: heights or projections [B, K, C, p, p].
            in_hand: [B, C', h, w].
            scene: feature map [S, C'', h', w'] of the first S samples, which repeat B / S times.
            holding: [B, 1], which selects the primitive.
        """
        x = self._features(views, in_hand).unflatten(0, views.shape[:2])
        of_view, of_scene = self.values.weight.split([x.shape[-1], self.scene.out_features], dim=1)
        values = F.linear(x, of_view)
        scene_values = F.linear(F.relu(self.scene(scene)), of_scene, self.values.bias)
        values += scene_values.repeat(len(views) // len(scene), 1)[:, None]
        values = values.unflatten(-1, (2, self.values_per_view)).transpose(1, 2)
        return select_primitive(values.flatten(2), holding)[:, 0]

    def _features(self, views: Tensor, in_hand: Tensor) -> Tensor:
        """Return float32 features [B * K, n]."""
        first, *others = self.convs
        hand = centre_fit(scaled_in_hand(self.config, in_hand), views.shape[-1])
        of_view, of_hand = first.weight.split([views.shape[2], hand.shape[1]], dim=1)
        # Both convolutions add up to one of the concatenated channels.
        x = _convolve(scaled_in_hand(self.config, views.flatten(0, 1)), of_view, first.bias)
        x.unflatten(0, views.shape[:2]).add_(_convolve(hand, of_hand)[:, None])
        for conv in others:
            x = conv(relu_of_max_pool(x))
        x = F.relu(x, inplace=True).flatten(1).float()
        return F.relu(self.narrow(F.relu(self.wide(x))))


class FingerSymmetricValues(nn.Module):
    """Q values that do not change when the fingers are swapped: the mean over both orders.

    Half a turn of the tool about its own axis turns the views and what is held by half a turn.

    Args:
        values: of one order of the fingers.
    """

    def __init__(self, values: PoseValues, in_hand: ImageSpec) -> None:
        super().__init__()
        self.values = values
        self.in_hand = in_hand

    def forward(self, views: Tensor, in_hand: Tensor, scene: Tensor, holding: Tensor) -> Tensor:
        """Return values [B, K * values_per_view] of views [B, 2 K, C, p, p], see
        `BothFingerOrders`; the other arguments are as in `PoseValues`."""
        views = torch.cat(views.chunk(2, dim=1))
        in_hand = torch.cat([in_hand, self.in_hand.reverse_axes(in_hand, "xy")])
        values = self.values(views, in_hand, scene, holding.repeat(2, 1))
        return torch.stack(values.chunk(2)).mean(dim=0)
