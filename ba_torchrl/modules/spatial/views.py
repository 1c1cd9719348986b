"""Planar views of the scene, such as a patch of heights around the chosen pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from ba_torchrl.modules.layers import constants


def sampling_grid(center_px: Tensor, yaw_rad: Tensor, size: int, image_size: int) -> Tensor:
    """Return where a square view samples a square image, for ``grid_sample``.

    The view has the frame of a gripper at this yaw: its row axis is the image's row axis rotated by
    the yaw, so the view shows the scene rotated by minus the yaw.

    Args:
        center_px: rows and columns of the views' centres [N, 2]; pixel (i, j) has its centre at
            (i + 1/2, j + 1/2).
        yaw_rad: [N].
        size: rows and columns of the views, whose pixels have the size of the image's pixels.
        image_size: rows and columns of the image.

    Returns:
        [N, size, size, 2], column then row; -1 and 1 are the outer edges of the image.
    """
    offsets = torch.arange(size, dtype=center_px.dtype, device=center_px.device) - (size - 1) / 2
    along, across = torch.meshgrid(offsets, offsets, indexing="ij")
    cos, sin = yaw_rad.cos()[:, None, None], yaw_rad.sin()[:, None, None]
    rows = center_px[:, 0, None, None] + cos * along - sin * across
    columns = center_px[:, 1, None, None] + sin * along + cos * across
    return torch.stack([columns, rows], dim=-1) * (2 / image_size) - 1


def sample(images: Tensor, grid: Tensor) -> Tensor:
    """Return views [N, C, h, w] of float32 images [N, C, H, W], zero outside the images."""
    return F.grid_sample(images, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


def patches(images: Tensor, pixels: Tensor, size: int, yaw_rad: Tensor | None = None) -> Tensor:
    """Return a patch around one pixel of each image.

    The centre of the patch is the centre of the pixel. With an even size and no yaw, every value is
    therefore the mean of four neighbouring pixels.

    Args:
        images: float32 [B, C, H, H].
        pixels: int64 [B, 2], row and column.
        size: rows and columns of the patch.
        yaw_rad: rotation of the patch relative to the image, [B]; zero if None.

    Returns:
        [B, C, size, size]; zero outside the image.
    """
    center_px = pixels.to(images.dtype) + 0.5
    yaw_rad = torch.zeros_like(center_px[:, 0]) if yaw_rad is None else yaw_rad
    return sample(images, sampling_grid(center_px, yaw_rad, size, images.shape[-1]))


def centre_fit(images: Tensor, size: int) -> Tensor:
    """Return images [B, C, h, h] cropped, or padded with zeros, to ``size`` about their centre;
    the two sizes differ by an even number."""
    margin = (size - images.shape[-1]) // 2
    return F.pad(images, (margin,) * 4) if margin else images


@dataclass(frozen=True)
class HeightView:
    """Heights around the chosen pixel, rotated into the chosen yaw if yaws are given.

    Args:
        size: rows and columns of the patch.
        rz_rad: yaw of each index; None for the axes of the scene.
    """

    size: int
    rz_rad: tuple[float, ...] | None = None
    channels: ClassVar[int] = 1

    def __call__(self, heightmap: Tensor, chosen: Tensor) -> Tensor:
        """Return one patch per sample [B, 1, 1, p, p], metres."""
        yaw = None
        if self.rz_rad is not None:
            yaw = constants(tuple(self.rz_rad), heightmap.device).to(heightmap.dtype)[chosen[:, 2]]
        return patches(heightmap, chosen[:, :2], self.size, yaw)[:, None]
