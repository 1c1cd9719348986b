"""Shared by the image networks: input assembly, compute precision and the convolution trunk."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.modules.actor_critic.image_config import ImageNetworkConfig
from ba_torchrl.modules.base import LOG_STD_MAX, LOG_STD_MIN
from ba_torchrl.modules.layers import XavierInitialised, check_image, compute_dtype
from ba_torchrl.modules.steerable.max_pool import relu_of_max_pool

SUPPORTED_IMAGE_SIZES = (64, 128)


def trunk_stages(image_size: int, widths: Iterable[int]) -> list[tuple[int, int, bool]]:
    """Return (width, padding, pools) of each stage of a trunk that ends at one pixel.

    The padding is as for a 3x3 convolution before a 2x2 pool; in place of both, a 4x4 convolution
    with stride 2 gives the same size. 128 px shrink to 8 in four pooled stages; then come 8 -> 8,
    8 -> 6 with a pool to 3, and 3 -> 1. At 64 px the first stage is left out (design, section 2).

    Args:
        image_size: pixels, 64 or 128.
        widths: the seven widths of the 128 px trunk.
    """
    if image_size not in SUPPORTED_IMAGE_SIZES:
        raise ValueError(
            f"this network takes images of {' or '.join(map(str, SUPPORTED_IMAGE_SIZES))} px, got "
            f"{image_size}; set obs_size, or views.size where views are crops"
        )
    paddings, pools = (1, 1, 1, 1, 1, 0, 0), (True, True, True, True, False, True, False)
    stages = list(zip(widths, paddings, pools, strict=True))
    return stages if image_size == 128 else stages[1:]


class ImageTrunk(XavierInitialised):
    """Depth image and holding flag to one feature vector, through convolutions.

    Activations are channels-last in the compute dtype; parameters stay float32 and each
    convolution casts its own filter. The result is float32. Vectors of the observation are appended
    to it.

    Args:
        convs: convolutions that take and return plain tensors in the input's dtype.
        pools: for each, whether a 2x2 max pool follows.
        config: precision and the input's units.
        shape: of an image, [C, H, W].
    """

    def __init__(
        self,
        convs: Iterable[nn.Module],
        pools: Iterable[bool],
        config: ImageNetworkConfig,
        shape: Sequence[int],
    ) -> None:
        super().__init__()
        self.convs = nn.ModuleList(convs)
        self.pools = tuple(pools)
        self.config = config
        self.shape = torch.Size(shape)

    def forward(self, depth: Tensor, holding: Tensor, *vectors: Tensor) -> Tensor:
        """Return features [..., F] of depth [..., C, H, W], holding [..., 1] and vectors."""
        check_image("depth", depth, self.shape)
        leading = depth.shape[:-3]
        x = self._input(depth.flatten(0, -4) if leading else depth[None], holding)
        slope = self.config.negative_slope
        for conv, pool in zip(self.convs, self.pools, strict=True):
            x = conv(x)
            if pool:
                x = relu_of_max_pool(x, slope)
            else:
                x = F.leaky_relu(x, slope) if slope else F.relu(x)
        features = x.flatten(1).float().reshape(*leading, -1)
        return torch.cat([features, *vectors], dim=-1) if vectors else features

    def _input(self, depth: Tensor, holding: Tensor) -> Tensor:
        """Return the input of the first convolution [B, C', H, W], channels-last."""
        dtype = compute_dtype(self.config.precision, depth.device)
        center, scale = self.config.depth_center_m, self.config.depth_scale_m
        if self.config.depth_reference == "floor":
            floor = depth.amax((-2, -1), keepdim=True)
            parts = [(floor - depth) / scale, ((floor - center) / scale).expand_as(depth)]
        else:
            parts = [depth if (center, scale) == (0, 1) else (depth - center) / scale]
        parts.append(holding.reshape(-1, 1, 1, 1).expand(-1, 1, *depth.shape[-2:]))
        channels_last = [part.movedim(1, -1).to(dtype) for part in parts]
        return torch.cat(channels_last, dim=-1).movedim(-1, 1)


def scale_from_log_std(log_std: Tensor) -> Tensor:
    """Return the standard deviation of a log standard deviation clamped to [-20, 2]."""
    return log_std.clamp(LOG_STD_MIN, LOG_STD_MAX).exp()
