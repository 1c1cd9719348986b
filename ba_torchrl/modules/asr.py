"""The plain network that chooses a pixel, then a yaw, then height and tilts if the action has them
(appendix D.2, G.1; "ASR")."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.modules.asr_base import ASR, ASRNetworkConfig, PatchView
from ba_torchrl.modules.base import NETWORKS
from ba_torchrl.modules.cnn import initialise_plain
from ba_torchrl.modules.in_hand_encoders import InHandMap
from ba_torchrl.modules.patches import centre_fit
from ba_torchrl.modules.pose_values import PoseValues, SceneMapVector
from ba_torchrl.modules.pose_views import (
    HeightView,
    PoseGridConfig,
    TiltedView,
    UprightView,
    is_six_dof,
)
from ba_torchrl.modules.spatial import SpatialSpec
from ba_torchrl.modules.spatial_inputs import (
    UNET_STRIDE,
    SpatialImageConfig,
    require_yaw,
    select_primitive,
)
from ba_torchrl.modules.trunk import scaled_width
from ba_torchrl.modules.unet import PlainPixelValues

_LARGEST_MAP = 8


class PlainYawValues(nn.Module):
    """Q values of yaws from a patch, the in-hand image and the scene feature map.

    Args:
        spec: shapes of the images.
        config: width, precision, units.
        num_yaws: number of yaws.
        patch_size: rows and columns of the patch.
        scene_channels: channels of the scene map.

    Raises:
        ValueError: the patch is too small.
    """

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
        hidden = scaled_width(1024, config.width)
        self.linear = nn.Linear(
            self.patch.out_channels * self.map_size**2
            + scene_channels * (spec.image_size // UNET_STRIDE) ** 2,
            hidden,
        )
        self.values = nn.Linear(hidden, 2 * num_yaws)
        self.apply(initialise_plain)

    def forward(self, patch: Tensor, in_hand: Tensor, scene: Tensor, holding: Tensor) -> Tensor:
        """Return values [B, yaws].

        Args:
            patch: heights around the pixel [B, 1, p, p].
            in_hand: [B, C, h, w].
            scene: [B, scene_channels, H/16, W/16].
            holding: [B, 1], which selects the primitive.
        """
        hand = centre_fit(self.config.in_hand(in_hand), patch.shape[-1])
        x = self.patch(torch.cat([self.config.heights(patch), hand], dim=1))
        if x.shape[-1] != self.map_size:
            size = (self.map_size, self.map_size)
            x = F.interpolate(x, size, mode="bilinear", align_corners=False)
        x = torch.cat([x.flatten(1), scene.flatten(1)], dim=1).float()
        return select_primitive(self.values(F.relu(self.linear(x))), holding)


@NETWORKS.register("asr")
class ASRConfig(ASRNetworkConfig, PoseGridConfig):
    """Hyper-parameters of the plain network that chooses one component after the other.

    The hyper-parameters of z and the tilts apply to actions in six degrees of freedom only.
    """

    def build(self, spec: SpatialSpec) -> ASR:
        """Return a freshly initialised network.

        Args:
            spec: shapes and the action's components: x, y and rz, or x, y, z, rz, ry and rx.

        Raises:
            ValueError: a size does not fit, or the action has other components.
        """
        if is_six_dof(spec):
            return self._build_for_poses(spec)
        require_yaw("asr", spec)
        levels, patch_size = self._planar_layout("asr", spec)
        positions = PlainPixelValues(spec, self, maps=1)
        yaws = PlainYawValues(spec, self, self.num_rotations, patch_size, positions.scene_channels)
        return ASR(positions, [(PatchView(patch_size), yaws)], levels)

    def _build_for_poses(self, spec: SpatialSpec) -> ASR:
        """Return the network of five levels; every later level has one view and all its values."""
        planar, patch_size = self._planar_layout("asr", spec)
        levels = (*planar, *self.pose_levels())
        grid = self.pose_grid(self.num_rotations, spec.half_rotation)
        positions = PlainPixelValues(spec, self, maps=1)
        views = (
            HeightView(patch_size),
            HeightView(patch_size, grid.rz_rad),
            UprightView(grid, spec.pixel_m, patch_size),
            TiltedView(grid._replace(rx_rad=(0.0,)), spec.pixel_m, patch_size),
        )
        in_voxels = self.in_voxels(spec.pixel_m)
        heads = [
            PoseValues(
                spec,
                in_voxels,
                view.channels,
                level.shape[0],
                patch_size,
                SceneMapVector(positions.scene_channels, spec.image_size, self.width),
            )
            for view, level in zip(views, levels[1:], strict=True)
        ]
        return ASR(positions, list(zip(views, heads, strict=True)), levels, self.limits)
