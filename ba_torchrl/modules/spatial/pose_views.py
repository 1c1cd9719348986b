"""What the levels of z and the tilts see of the scene: projections at poses (appendix D.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from ba_torchrl.modules.layers import constants
from ba_torchrl.modules.spatial.base import Level, SpatialSpec
from ba_torchrl.modules.spatial.pose_grid_config import PoseGridConfig
from ba_torchrl.modules.spatial.projections import cell_table, project, project_upright
from ba_torchrl.modules.spatial.views import patches

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


def pose_levels(config: PoseGridConfig) -> tuple[Level, Level, Level]:
    """Return the levels of z, ry and rx."""
    counts = {"z": config.num_z, "ry": config.num_tilts, "rx": config.num_tilts}
    return tuple(Level((name,), (count,)) for name, count in counts.items())


def pose_grid(config: PoseGridConfig, num_rotations: int, half_rotation: bool) -> PoseGrid:
    """Return the values of z and the angles; yaws span half a turn or a whole one."""
    turn = math.pi if half_rotation else 2 * math.pi
    values = {
        level.components[0]: _spaced(*config.limits[level.components[0]], level.shape[0])
        for level in pose_levels(config)
    }
    yaws = tuple(i * (turn / num_rotations) for i in range(num_rotations))
    return PoseGrid(values["z"], yaws, values["ry"], values["rx"])


def _spaced(first: float, last: float, count: int) -> tuple[float, ...]:
    step = (last - first) / (count - 1)
    return tuple(first + i * step for i in range(count))


@dataclass(frozen=True)
class _PoseView:
    """Projections of the patch of ``size`` pixels around the chosen pixel."""

    grid: PoseGrid
    pixel_m: float
    size: int
    channels: ClassVar[int] = 3


class UprightView(_PoseView):
    """Projections at the chosen pixel and yaw: at the chosen z, or at every z if none is chosen."""

    def __call__(self, heightmap: Tensor, chosen: Tensor) -> Tensor:
        """Return projections [B, K, 3, p, p], voxels."""
        patch = patches(heightmap, chosen[:, :2], self.size)[:, 0]
        heights, yaws = (
            constants(tuple(values), heightmap.device)
            for values in (self.grid.z_m, self.grid.rz_rad)
        )
        z = heights.expand(len(patch), -1) if chosen.shape[1] == 3 else heights[chosen[:, 3:4]]
        return project_upright(patch, self.pixel_m, z, yaws[chosen[:, 2]])


class TiltedView(_PoseView):
    """Projections at the chosen pixel, yaw and z: at the chosen ry, or at every ry if none is
    chosen, with every rx.

    The grid has a single rx of zero for views before rx is chosen.
    """

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
