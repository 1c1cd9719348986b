"""Shared by the image networks: input assembly, compute precision and the convolution trunk."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

from ba_torchrl.core import keys
from ba_torchrl.modules.base import (
    LOG_STD_MAX,
    LOG_STD_MIN,
    ActorCriticSpec,
    Control,
    NetworkConfig,
)
from ba_torchrl.modules.layers import Precision, XavierInitialised, compute_dtype
from ba_torchrl.modules.steerable.max_pool import relu_of_max_pool

SUPPORTED_IMAGE_SIZES = (64, 128)


def trunk_stages(image_size: int, widths: Iterable[int]) -> list[tuple[int, int, bool]]:
    """Return (width, padding, pools) of each stage of a trunk that ends at one pixel.

    The padding is that of a 3x3 convolution before a 2x2 pool; in place of both, a 4x4 convolution
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


class ImageNetworkConfig(NetworkConfig):
    """Hyper-parameters that every network on depth images has.

    The input of the networks is (depth - depth_center_m) / depth_scale_m. The defaults keep metres,
    as the reference implementation does. With a center of 0.2 and a scale of 0.1, inputs have unit
    size and differences of a block's height are well above the resolution of bfloat16; learning is
    much faster.

    With the floor as the reference, the floor's depth is an input of its own, the same at all
    pixels, and the image becomes heights above it, so that the activations of the floor do not
    exceed those of the objects on it.

    Args:
        precision: number format of the convolutions, see `compute_dtype`.
        depth_reference: "camera", or "floor" for two inputs: height above the lowest visible point,
            and the depth of that point.
        depth_center_m: depth that is scaled to zero.
        depth_scale_m: difference in depth that is scaled to one.
        negative_slope: slope of the activation function below zero; 0 is a ReLU, as in the
            reference implementation. After a max pool, narrow layers with a ReLU can hide an object
            completely, and then receive no gradient from it.
        vector_keys: keys of vectors in the observation that join the features of the image, such
            as "proprio"; none in the paper.
    """

    control: ClassVar[Control] = "close_loop"
    image_keys: ClassVar[tuple[str, ...]] = (keys.DEPTH,)

    precision: Precision = "auto"
    depth_reference: Literal["camera", "floor"] = "camera"
    depth_center_m: float = 0.0
    depth_scale_m: float = Field(default=1.0, gt=0)
    negative_slope: float = Field(default=0.0, ge=0, lt=1)
    vector_keys: list[str] = Field(default=[])

    def input_channels(self, image_channels: int) -> int:
        """Return the number of input channels of the first convolution."""
        return image_channels + (1 if self.depth_reference == "camera" else 2)

    def check_images(self, spec: ActorCriticSpec) -> None:
        """Refuse images that are not depth or height, nothing below zero, in one channel."""
        for key, image in spec.images.items():
            if image.channels != 1 or image.low < 0:
                raise ValueError(
                    f"{key} has {image.channels} channels with values from {image.low:g}; this "
                    "network takes depth or height in one channel, nothing below zero: choose "
                    "another view_type"
                )


class ImageTrunk(XavierInitialised):
    """Depth image and holding flag to one feature vector, through convolutions.

    Activations are channels-last in the compute dtype; parameters stay float32 and each
    convolution casts its own filter. The result is float32. Vectors of the observation are appended
    to it.

    Args:
        convs: convolutions that take and return plain tensors in the input's dtype.
        pools: for each, whether a 2x2 max pool follows.
        config: precision and the input's units.
    """

    def __init__(
        self, convs: Iterable[nn.Module], pools: Iterable[bool], config: ImageNetworkConfig
    ) -> None:
        super().__init__()
        self.convs = nn.ModuleList(convs)
        self.pools = tuple(pools)
        self.config = config

    def forward(self, depth: Tensor, holding: Tensor, *vectors: Tensor) -> Tensor:
        """Return features [..., F] of depth [..., C, H, W], holding [..., 1] and vectors."""
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
