"""The FCN that evaluates rotated images, one per yaw (appendix G.1; "Rot FCN")."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from ba_torchrl.modules.spatial.base import (
    UNET_STRIDE,
    Level,
    SpatialQNetwork,
    SpatialSpec,
    require_yaw,
    yaws_rad,
)
from ba_torchrl.modules.spatial.rot_fcn_config import RotFCNConfig
from ba_torchrl.modules.spatial.unet import PlainPixelValues
from ba_torchrl.modules.spatial.views import sample, sampling_grid


class RotFCN(SpatialQNetwork):
    """Rotates the image into the frame of each yaw, computes pixel values, and rotates them back.

    Args:
        values: (heightmap, in_hand, holding) -> (values [n*B, 1, P, P], bottleneck map) of n views.
        half_rotation: whether the yaws span half a turn.
    """

    def __init__(
        self, values: nn.Module, image_size: int, num_yaws: int, half_rotation: bool
    ) -> None:
        super().__init__()
        self.values = values
        self.levels = (Level(("rz", "x", "y"), (num_yaws, image_size, image_size)),)
        self.half_rotation = half_rotation
        # Large enough for the image at any angle: 90 pixels become 128.
        self.padded_size = math.ceil(image_size * math.sqrt(2) / UNET_STRIDE) * UNET_STRIDE

    def first(self, heightmap: Tensor, in_hand: Tensor, holding: Tensor) -> tuple[Tensor, Any]:
        """Return the Q values [B, yaws, H, W], and None as the state."""
        num_yaws, size, _ = self.levels[0].shape
        padded, batch = self.padded_size, len(heightmap)
        yaws = yaws_rad(num_yaws, self.half_rotation, heightmap.device)
        centers = heightmap.new_full((num_yaws, 2), size / 2)
        # The sampling grid of a view is the same for all images, so the batch becomes its channels.
        images = heightmap[:, 0].expand(num_yaws, -1, -1, -1)
        views = sample(images, sampling_grid(centers, yaws, padded, size))
        values, _ = self.values(views.reshape(-1, 1, padded, padded), in_hand, holding)
        values = values.reshape(num_yaws, batch, padded, padded)
        centers = torch.full_like(centers, padded / 2)
        return sample(values, sampling_grid(centers, -yaws, size, padded)).transpose(0, 1), None


def build_rot_fcn(config: RotFCNConfig, spec: SpatialSpec) -> RotFCN:
    """Return a freshly initialised network for x, y and rz."""
    require_yaw("rot_fcn", spec)
    if spec.image_size % 2:
        raise ValueError(
            f"network 'rot_fcn' pads the image equally on all sides, which needs an even "
            f"obs_size; got {spec.image_size}"
        )
    values = PlainPixelValues(spec, config, maps=1)
    return RotFCN(values, spec.image_size, config.num_rotations, spec.half_rotation)
