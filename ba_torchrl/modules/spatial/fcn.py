"""Fully convolutional Q networks: one value per pixel, or per yaw and pixel (appendix D.1, G.1)."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from ba_torchrl.modules.spatial.base import (
    Level,
    SpatialQNetwork,
    SpatialSpec,
    has_yaw,
    require_unet_size,
)
from ba_torchrl.modules.spatial.equi_unet import EquivariantPixelValues
from ba_torchrl.modules.spatial.fcn_config import EquiFCNConfig, FCNConfig
from ba_torchrl.modules.spatial.unet import PlainPixelValues
from ba_torchrl.modules.steerable.planar import planar_rotations, planar_yaws

_DEFAULT_GROUP_ORDER = 4


class FCN(SpatialQNetwork):
    """A network with one value for each pixel, or for each pair of a yaw and a pixel.

    Args:
        values: (heightmap, in_hand, holding) -> (values [B, maps, H, W], bottleneck map).
        num_yaws: number of yaws, with one map each; None for a single map without yaws.
    """

    def __init__(self, values: nn.Module, image_size: int, num_yaws: int | None) -> None:
        super().__init__()
        self.values = values
        pixels = (image_size, image_size)
        if num_yaws is None:
            self.levels = (Level(("x", "y"), pixels),)
        else:
            self.levels = (Level(("rz", "x", "y"), (num_yaws, *pixels)),)

    def first(self, heightmap: Tensor, in_hand: Tensor, holding: Tensor) -> tuple[Tensor, Any]:
        """Return the Q values [B, H, W] or [B, yaws, H, W], and None as the state."""
        values, _ = self.values(heightmap, in_hand, holding)
        return values.reshape(-1, *self.levels[0].shape), None


def build_fcn(config: FCNConfig, spec: SpatialSpec) -> FCN:
    """Return a freshly initialised network for x, y and perhaps rz."""
    num_yaws = config.num_rotations if has_yaw("fcn", spec) else None
    require_unet_size("fcn", spec.image_size)
    return FCN(PlainPixelValues(spec, config, num_yaws or 1), spec.image_size, num_yaws)


def build_equi_fcn(config: EquiFCNConfig, spec: SpatialSpec) -> FCN:
    """Return a freshly initialised network for x, y and perhaps rz."""
    yaw = has_yaw("equi_fcn", spec)
    require_unet_size("equi_fcn", spec.image_size)
    if not yaw:
        group = planar_rotations(config.group_order or _DEFAULT_GROUP_ORDER, has_flips=True)
        values = EquivariantPixelValues(group.trivial_repr, spec, config)
        return FCN(values, spec.image_size, None)
    if config.group_order is not None:
        raise ValueError("num_rotations sets the group of 'equi_fcn': leave out group_order")
    yaws = planar_yaws(config.num_rotations, spec.half_rotation)
    values = EquivariantPixelValues(yaws, spec, config)
    return FCN(values, spec.image_size, config.num_rotations)
