"""Augmented state representation: a pixel, then one component of the pose after the other.

The plain network chooses a pixel, then a yaw, then height and tilts if the action has them
(appendix D.2, G.1; "ASR").
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.modules.layers import XavierInitialised
from ba_torchrl.modules.spatial.asr_config import ASRConfig, ASRNetworkConfig
from ba_torchrl.modules.spatial.base import (
    UNET_STRIDE,
    Level,
    SpatialQNetwork,
    SpatialSpec,
    dense_width,
    require_unet_size,
    require_yaw,
    scaled_heights,
    scaled_in_hand,
    select_primitive,
)
from ba_torchrl.modules.spatial.in_hand import InHandMap
from ba_torchrl.modules.spatial.pose_values import PoseValues, SceneMapVector
from ba_torchrl.modules.spatial.pose_views import (
    TiltedView,
    UprightView,
    is_six_dof,
    pose_grid,
    pose_levels,
)
from ba_torchrl.modules.spatial.spatial_config import SpatialImageConfig
from ba_torchrl.modules.spatial.unet import PlainPixelValues
from ba_torchrl.modules.spatial.views import HeightView, centre_fit

View = Callable[[Tensor, Tensor], Tensor]
"""From heightmaps [B, 1, H, W] and the indices chosen so far [B, n] to what a later level sees."""


class ASRState(NamedTuple):
    """Inputs of the later levels besides the choices: the images and the first level's features."""

    heightmap: Tensor
    in_hand: Tensor
    holding: Tensor
    scene: Tensor


class ASR(SpatialQNetwork):
    """A network that chooses a pixel first, then one more component of the action per level.

    All levels share the first level's feature map, so the losses of the later levels also train the
    first level's encoder.

    Args:
        positions: (heightmap, in_hand, holding) -> (values [B, 1, H, W], scene feature map).
        later: for each later level, its view of the heightmap around the chosen pixel, and its
            head: (view, in_hand, scene feature map, holding) -> values [B, n].
        levels: pixels, then one component each.
        limits: first and last value on the grids of z and the tilts.
    """

    def __init__(
        self,
        positions: nn.Module,
        later: Sequence[tuple[View, nn.Module]],
        levels: Sequence[Level],
        limits: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        super().__init__()
        self.positions = positions
        self.views = tuple(view for view, _ in later)
        self.heads = nn.ModuleList(head for _, head in later)
        self.levels = tuple(levels)
        self.limits = dict(limits or {})

    def first(self, heightmap: Tensor, in_hand: Tensor, holding: Tensor) -> tuple[Tensor, ASRState]:
        """Return the Q values [B, H, W] of the pixels, and the state for `later`."""
        values, scene = self.positions(heightmap, in_hand, holding)
        return values.squeeze(1), ASRState(heightmap, in_hand, holding, scene)

    def later(self, level: int, state: Any, chosen: Tensor) -> Tensor:
        if not 1 <= level < len(self.levels):
            raise ValueError(
                f"the later levels of this network are 1 to {len(self.levels) - 1}, got {level}"
            )
        view = self.views[level - 1](state.heightmap, chosen)
        return self.heads[level - 1](view, state.in_hand, state.scene, state.holding)


def planar_layout(
    config: ASRNetworkConfig, name: str, spec: SpatialSpec
) -> tuple[tuple[Level, Level], int]:
    """Return the levels of pixels and yaws, and the patch's size."""
    require_unet_size(name, spec.image_size)
    patch_size = config.patch_size or spec.in_hand_size
    if (patch_size - spec.in_hand_size) % 2:
        raise ValueError(
            f"patch_size and in_hand_size must share a centre, so differ by an even number of "
            f"pixels; got {patch_size} and {spec.in_hand_size}"
        )
    pixels = Level(("x", "y"), (spec.image_size, spec.image_size))
    return (pixels, Level(("rz",), (config.num_rotations,))), patch_size


_LARGEST_MAP = 8


class PlainYawValues(XavierInitialised):
    """Q values of yaws from a patch, the in-hand image and the scene feature map."""

    def __init__(
        self,
        spec: SpatialSpec,
        config: SpatialImageConfig,
        num_yaws: int,
        patch_size: int,
        scene_channels: int,
    ) -> None:
        super().__init__()
        self.config = config
        self.patch = InHandMap(1 + spec.in_hand_channels, patch_size, config.width)
        self.map_size = min(self.patch.out_size, _LARGEST_MAP)
        hidden = dense_width(config, 1024)
        self.linear = nn.Linear(
            self.patch.out_channels * self.map_size**2
            + scene_channels * (spec.image_size // UNET_STRIDE) ** 2,
            hidden,
        )
        self.values = nn.Linear(hidden, 2 * num_yaws)
        self.reset_parameters()

    def forward(self, patch: Tensor, in_hand: Tensor, scene: Tensor, holding: Tensor) -> Tensor:
        """Return values [B, yaws].

        Args:
            patch: heights around the pixel [B, 1, 1, p, p].
            in_hand: [B, C, h, w].
            scene: [B, scene_channels, H/16, W/16].
            holding: [B, 1], which selects the primitive.
        """
        hand = centre_fit(scaled_in_hand(self.config, in_hand), patch.shape[-1])
        x = self.patch(torch.cat([scaled_heights(self.config, patch[:, 0]), hand], dim=1))
        if x.shape[-1] != self.map_size:
            size = (self.map_size, self.map_size)
            x = F.interpolate(x, size, mode="bilinear", align_corners=False)
        x = torch.cat([x.flatten(1), scene.flatten(1)], dim=1).float()
        return select_primitive(self.values(F.relu(self.linear(x))), holding)


def build_asr(config: ASRConfig, spec: SpatialSpec) -> ASR:
    """Return a freshly initialised network for x, y and rz, or x, y, z, rz, ry and rx."""
    if is_six_dof(spec):
        return _build_for_poses(config, spec)
    require_yaw("asr", spec)
    levels, patch_size = planar_layout(config, "asr", spec)
    positions = PlainPixelValues(spec, config, maps=1)
    yaws = PlainYawValues(spec, config, config.num_rotations, patch_size, positions.scene_channels)
    return ASR(positions, [(HeightView(patch_size), yaws)], levels)


def _build_for_poses(config: ASRConfig, spec: SpatialSpec) -> ASR:
    """Return the network of five levels; every later level has one view and all its values."""
    planar, patch_size = planar_layout(config, "asr", spec)
    levels = (*planar, *pose_levels(config))
    grid = pose_grid(config, config.num_rotations, spec.half_rotation)
    positions = PlainPixelValues(spec, config, maps=1)
    views = (
        HeightView(patch_size),
        HeightView(patch_size, grid.rz_rad),
        UprightView(grid, spec.pixel_m, patch_size),
        TiltedView(grid._replace(rx_rad=(0.0,)), spec.pixel_m, patch_size),
    )
    in_voxels = config.in_voxels(spec.pixel_m)
    heads = [
        PoseValues(
            spec,
            in_voxels,
            view.channels,
            level.shape[0],
            patch_size,
            SceneMapVector(positions.scene_channels, spec.image_size, config),
        )
        for view, level in zip(views, levels[1:], strict=True)
    ]
    return ASR(positions, list(zip(views, heads, strict=True)), levels, config.limits)
