"""The interface of spatial Q networks, their inputs, and checks of the actions they support."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.modules.layers import compute_dtype, scaled_width
from ba_torchrl.modules.spatial.spatial_config import SpatialImageConfig


@dataclass(frozen=True)
class SpatialSpec:
    """What a spatial Q network is built for: images, action and workspace.

    Args:
        images: declarations of the network's input images, by key, in the order of its arguments:
            the heightmap, the in-hand image (1 channel for "raw" and "sub", 3 for "proj"), others.
        components: components of the action except its primitive, in the order of the action: a
            subset of x, y, z, rz, ry, rx.
        half_rotation: whether yaws half a turn apart are equivalent.
        side_m: edge of the square workspace, which the heightmap covers.
    """

    images: Mapping[str, ImageSpec]
    components: tuple[str, ...]
    half_rotation: bool = True
    side_m: float = 0.4

    def __post_init__(self) -> None:
        if missing := {keys.HEIGHTMAP, keys.IN_HAND} - set(self.images):
            found = list(self.images)
            raise ConfigError(f"images lack {missing}: {found}; ActorCriticSpec takes depth images")
        if not {"x", "y"} <= set(self.components):
            raise ValueError(f"the action needs x and y, got {self.components}")

    @property
    def image_size(self) -> int:
        """Rows and columns of the heightmap."""
        return self.images[keys.HEIGHTMAP].size

    @property
    def pixel_m(self) -> float:
        """Edge of a pixel of the heightmap."""
        return self.side_m / self.image_size

    @property
    def in_hand_size(self) -> int:
        """Rows and columns of the in-hand image."""
        return self.images[keys.IN_HAND].size

    @property
    def in_hand_channels(self) -> int:
        """Channels of the in-hand image."""
        return self.images[keys.IN_HAND].channels


class Level(NamedTuple):
    """Components of the action that one maximisation chooses together.

    Fields:
        components: their names in the order of the axes of the Q values: x (rows of the image),
            y (columns), z, rz, ry, rx.
        shape: number of choices along each axis.
    """

    components: tuple[str, ...]
    shape: tuple[int, ...]


class SpatialQNetwork(nn.Module, ABC):
    """Base of open-loop networks, which choose an action level by level.

    The Q values of a level depend on the choices at the levels before. The primitive is not chosen:
    an empty gripper picks, a gripper that holds an object places. The values belong to this
    primitive.
    """

    levels: tuple[Level, ...]
    limits: Mapping[str, tuple[float, float]] = MappingProxyType({})
    """First and last value on the grids of z (metres) and the tilts (radians); components without
    an entry span the range of the action."""

    @abstractmethod
    def first(self, heightmap: Tensor, in_hand: Tensor, holding: Tensor) -> tuple[Tensor, Any]:
        """Return the Q values of the first level, and the state that `later` needs.

        Args:
            heightmap: heightmaps [B, 1, H, W], metres.
            in_hand: images of what is held [B, C, h, w].
            holding: [B, 1], true where an object is held; follows all input images.

        Returns:
            float32 ``[B, *levels[0].shape]``, and a state of any type, None if there is one level.
        """

    def later(self, level: int, state: Any, chosen: Tensor) -> Tensor:
        """Return the Q values of a later level.

        Args:
            level: index of the level, at least 1.
            state: from `first`.
            chosen: int64 [B, n], indices of the components chosen so far, level after level.

        Returns:
            float32 ``[B, *levels[level].shape]``.
        """
        raise NotImplementedError(f"{type(self).__name__} has one level")


UNET_STRIDE = 16
"""Pixels of the image per pixel of a UNet's bottleneck map; image sizes are multiples of it."""


def dense_width(config: SpatialImageConfig, width: int) -> int:
    """Return the width of a fully connected layer of ``width`` in the reference's size."""
    return scaled_width(width, config.width if config.dense_width is None else config.dense_width)


def scaled_heights(config: SpatialImageConfig, images: Tensor) -> Tensor:
    """Return heights [B, 1, H, W] divided by the scale, in the compute dtype."""
    scale = config.height_scale_m
    return _computed(config, images if scale == 1 else images / scale)


def scaled_in_hand(config: SpatialImageConfig, images: Tensor) -> Tensor:
    """Return scaled heights (C = 1) or projections [B, C, h, w] in the compute dtype."""
    if images.shape[1] == 1:
        return scaled_heights(config, images)
    return _computed(config, images if config.voxel_scale == 1 else images / config.voxel_scale)


def _computed(config: SpatialImageConfig, images: Tensor) -> Tensor:
    """Return images [B, C, H, W] in the compute dtype, channels-last."""
    dtype = compute_dtype(config.precision, images.device)
    return images.to(dtype=dtype, memory_format=torch.channels_last)


def select_primitive(values: Tensor, holding: Tensor) -> Tensor:
    """Return values of the primitive: of picks where nothing is held, else of places.

    Args:
        values: [B, 2n, ...], first for picks, then for places.
        holding: [B, 1].

    Returns:
        [B, n, ...].
    """
    pick, place = values.chunk(2, dim=1)
    return torch.where(holding.bool().reshape(-1, *[1] * (values.dim() - 1)), place, pick)


def has_yaw(name: str, spec: SpatialSpec) -> bool:
    """Return whether the action has a yaw besides x and y, for the network with a name.

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
    """Refuse an action without yaw."""
    if not has_yaw(name, spec):
        raise ValueError(
            f"network {name!r} chooses a yaw, and the action has no rz; use 'fcn' or 'equi_fcn', "
            "or an action_sequence with r, such as 'pxyr'"
        )


def require_unet_size(name: str, image_size: int) -> None:
    """Refuse images that a UNet cannot halve four times."""
    if image_size % UNET_STRIDE:
        raise ValueError(
            f"network {name!r} needs an obs_size that is a multiple of {UNET_STRIDE}, got "
            f"{image_size}; 'rot_fcn' takes any even one"
        )


def yaws_rad(count: int, half_rotation: bool, device: torch.device) -> Tensor:
    """Return the yaw of each index of a yaw axis, [count]."""
    period_rad = math.pi if half_rotation else 2 * math.pi
    return torch.arange(count, device=device) * (period_rad / count)
