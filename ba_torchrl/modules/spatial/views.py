"""What later levels see of the scene: rotated crops, and projections at poses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from ba_torchrl.core.config import StrictModel
from ba_torchrl.modules.layers import constants
from ba_torchrl.modules.spatial.base import Level, SpatialSpec
from ba_torchrl.modules.spatial.projections import cell_table, project, project_upright


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
    offsets = torch.arange(size, device=center_px.device) - (size - 1) / 2
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


POSE_COMPONENTS = ("x", "y", "rz", "z", "ry", "rx")
"""Components of six degrees of freedom in the order of their choice (appendix D.2)."""


class PoseGrid(NamedTuple):
    """The values of each component, by index."""

    z_m: tuple[float, ...]
    rz_rad: tuple[float, ...]
    ry_rad: tuple[float, ...]
    rx_rad: tuple[float, ...]

    def with_swapped_fingers(self) -> PoseGrid:
        """Return the poses after half a turn of the tool about its own axis, by the same index."""
        return PoseGrid(
            self.z_m,
            tuple(yaw + math.pi for yaw in self.rz_rad),
            *(tuple(-tilt for tilt in tilts) for tilts in (self.ry_rad, self.rx_rad)),
        )


def is_six_dof(spec: SpatialSpec) -> bool:
    """Return whether the action has a position and three angles."""
    return set(spec.components) == set(POSE_COMPONENTS)


class PoseGridConfig(StrictModel):
    """Hyper-parameters of the levels of z and the tilts; the defaults are those of the
    reference implementation; the appendix gives none.

    Args:
        num_z: heights of the tool, evenly spaced.
        min_z_m: least height.
        max_z_m: greatest height.
        num_tilts: values of ry, and of rx, evenly spaced.
        max_tilt_rad: greatest tilt; the least is its negative.
    """

    num_z: int = Field(default=36, ge=2)
    min_z_m: float = 0.02
    max_z_m: float = 0.20
    num_tilts: int = Field(default=7, ge=2)
    max_tilt_rad: float = Field(default=math.pi / 8, gt=0)

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """First and last value on the grids of z and the tilts."""
        tilts = (-self.max_tilt_rad, self.max_tilt_rad)
        return {"z": (self.min_z_m, self.max_z_m), "ry": tilts, "rx": tilts}

    def pose_levels(self) -> tuple[Level, Level, Level]:
        """Return the levels of z, ry and rx."""
        counts = {"z": self.num_z, "ry": self.num_tilts, "rx": self.num_tilts}
        return tuple(Level((name,), (count,)) for name, count in counts.items())

    def pose_grid(self, num_rotations: int, half_rotation: bool) -> PoseGrid:
        """Return the values of z and the angles; yaws span half a turn or a whole one."""
        turn = math.pi if half_rotation else 2 * math.pi
        values = {
            level.components[0]: _spaced(*self.limits[level.components[0]], level.shape[0])
            for level in self.pose_levels()
        }
        yaws = tuple(i * (turn / num_rotations) for i in range(num_rotations))
        return PoseGrid(values["z"], yaws, values["ry"], values["rx"])


def _spaced(first: float, last: float, count: int) -> tuple[float, ...]:
    step = (last - first) / (count - 1)
    return tuple(first + i * step for i in range(count))


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


@dataclass(frozen=True)
class UprightView:
    """Projections at the chosen pixel and yaw: at the chosen z, or at every z if none is chosen."""

    grid: PoseGrid
    pixel_m: float
    size: int
    channels: ClassVar[int] = 3

    def __call__(self, heightmap: Tensor, chosen: Tensor) -> Tensor:
        """Return projections [B, K, 3, p, p], voxels."""
        patch = patches(heightmap, chosen[:, :2], self.size)[:, 0]
        heights, yaws = (
            constants(tuple(values), heightmap.device)
            for values in (self.grid.z_m, self.grid.rz_rad)
        )
        z = heights.expand(len(patch), -1) if chosen.shape[1] == 3 else heights[chosen[:, 3:4]]
        return project_upright(patch, self.pixel_m, z, yaws[chosen[:, 2]])


@dataclass(frozen=True)
class TiltedView:
    """Projections at the chosen pixel, yaw and z: at the chosen ry, or at every ry if none is
    chosen, with every rx.

    Args:
        grid: values of the components; a single rx of zero for views before rx is chosen.
    """

    grid: PoseGrid
    pixel_m: float
    size: int
    channels: ClassVar[int] = 3

    def __call__(self, heightmap: Tensor, chosen: Tensor) -> Tensor:
        """Return projections [B, K, 3, p, p], voxels; ry is the outer index of the poses."""
        patch = patches(heightmap, chosen[:, :2], self.size)[:, 0]
        table = cell_table(*self.grid[1:], self.size, heightmap.device)
        cells = table[(chosen[:, 2], *chosen[:, 4:].unbind(1))]
        cells = cells.reshape(len(patch), -1, *cells.shape[-3:])
        heights = constants(tuple(self.grid.z_m), heightmap.device)
        z = heights[chosen[:, 3:4]].expand(-1, cells.shape[1])
        return project(patch, self.pixel_m, z, cells)


@dataclass(frozen=True)
class BothFingerOrders:
    """Projections of a view at the candidate poses, then at the same poses with swapped fingers."""

    view: UprightView | TiltedView

    @property
    def channels(self) -> int:
        """Channels of a projection."""
        return self.view.channels

    def __call__(self, heightmap: Tensor, chosen: Tensor) -> Tensor:
        """Return projections [B, 2 K, 3, p, p], voxels."""
        swapped = replace(self.view, grid=self.view.grid.with_swapped_fingers())
        return torch.cat([self.view(heightmap, chosen), swapped(heightmap, chosen)], dim=1)
