"""Inputs of the spatial Q networks, and checks of the actions that they support."""

from __future__ import annotations

import math
from typing import ClassVar, Self

import torch
from pydantic import Field
from torch import Tensor

from ba_torchrl.config import StrictModel
from ba_torchrl.envs import keys
from ba_torchrl.modules.base import Control
from ba_torchrl.modules.spatial import SpatialSpec
from ba_torchrl.modules.trunk import Precision, compute_dtype

UNET_STRIDE = 16
"""Pixels of the image per pixel of a UNet's bottleneck map; image sizes are multiples of it."""


class SpatialImageConfig(StrictModel):
    """Hyper-parameters of every spatial Q network.

    By default heights are in metres, as in the reference implementation, and a block of 3 cm hardly
    affects the values of a freshly initialised network. With a scale of 0.05 it has a height of
    about one, and learning is faster at the start.

    Args:
        precision: number format of the convolutions, see `compute_dtype`. Values of actions, the
            fully connected layers and the filters' coefficients are always float32.
        height_scale_m: height that is scaled to one. The floor stays zero, like the padding.
        voxel_scale: number of voxels of a projection that is scaled to one.
        width: factor on every layer's width; 1 is the reference's size.
    """

    control: ClassVar[Control] = "open_loop"
    image_keys: ClassVar[tuple[str, ...]] = (keys.PIXELS, keys.IN_HAND)

    precision: Precision = "auto"
    height_scale_m: float = Field(default=1.0, gt=0)
    voxel_scale: float = Field(default=1.0, gt=0)
    width: float = Field(default=1.0, gt=0)

    def heights(self, images: Tensor) -> Tensor:
        """Return heights [B, 1, H, W] divided by the scale, in the compute dtype."""
        return self.images(images if self.height_scale_m == 1 else images / self.height_scale_m)

    def in_hand(self, images: Tensor) -> Tensor:
        """Return scaled heights (C = 1) or projections [B, C, h, w] in the compute dtype."""
        if images.shape[1] == 1:
            return self.heights(images)
        return self.images(images if self.voxel_scale == 1 else images / self.voxel_scale)

    def in_voxels(self, pixel_m: float) -> Self:
        """Return a copy that scales heights like projections: their unit is a voxel.

        Args:
            pixel_m: edge of a pixel and a voxel.
        """
        return self.model_copy(update={"height_scale_m": pixel_m * self.voxel_scale})

    def images(self, images: Tensor) -> Tensor:
        """Return images [B, C, H, W] in the compute dtype, channels-last."""
        dtype = compute_dtype(self.precision, images.device)
        return images.to(dtype=dtype, memory_format=torch.channels_last)


def select_primitive(values: Tensor, holding: Tensor) -> Tensor:
    """Return the values of the primitive: those of picks where nothing is held, else of places.

    Args:
        values: [B, 2n, ...], first those of picks, then those of places.
        holding: [B, 1].

    Returns:
        [B, n, ...].
    """
    pick, place = values.chunk(2, dim=1)
    return torch.where(holding.bool().reshape(-1, *[1] * (values.dim() - 1)), place, pick)


def has_yaw(name: str, spec: SpatialSpec) -> bool:
    """Return whether the action has a yaw besides x and y.

    Args:
        name: of the network, for the error message.
        spec: holds the action's components.

    Raises:
        ValueError: the action has other components.
    """
    others = [c for c in spec.components if c not in ("x", "y", "rz")]
    if others:
        raise ValueError(
            f"network {name!r} chooses x, y and rz, not {', '.join(others)}; use an "
            "action_sequence without, such as 'pxy' or 'pxyr'"
        )
    return "rz" in spec.components


def require_yaw(name: str, spec: SpatialSpec) -> None:
    """Refuse an action without yaw.

    Raises:
        ValueError: the action has no yaw, or has components other than x, y and rz.
    """
    if not has_yaw(name, spec):
        raise ValueError(
            f"network {name!r} chooses a yaw, and the action has no rz; use 'fcn' or 'equi_fcn', "
            "or an action_sequence with r, such as 'pxyr'"
        )


def require_unet_size(name: str, image_size: int) -> None:
    """Refuse images that a UNet cannot halve four times.

    Raises:
        ValueError: the size is not a multiple of 16 pixels.
    """
    if image_size % UNET_STRIDE:
        raise ValueError(
            f"network {name!r} needs an obs_size that is a multiple of {UNET_STRIDE}, got "
            f"{image_size}; 'rot_fcn' takes any even one"
        )


def yaws_rad(count: int, half_rotation: bool, device: torch.device) -> Tensor:
    """Return the yaw of each index of a yaw axis, [count]."""
    period_rad = math.pi if half_rotation else 2 * math.pi
    return torch.arange(count, device=device) * (period_rad / count)
