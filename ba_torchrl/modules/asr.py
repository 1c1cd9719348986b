"""Augmented state representation: a pixel, then a yaw given that pixel (appendix D.2, G.1)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

from ba_torchrl.modules.base import NETWORKS
from ba_torchrl.modules.cnn import initialise_plain
from ba_torchrl.modules.in_hand_encoders import InHandMap
from ba_torchrl.modules.patches import centre_fit, patches
from ba_torchrl.modules.spatial import Level, SpatialQNetwork, SpatialSpec
from ba_torchrl.modules.spatial_inputs import (
    UNET_STRIDE,
    SpatialImageConfig,
    require_unet_size,
    require_yaw,
    select_primitive,
)
from ba_torchrl.modules.trunk import scaled_width
from ba_torchrl.modules.unet import PlainPixelValues

_LARGEST_MAP = 8


class ASRState(NamedTuple):
    """Inputs of the second level besides the pixel: the images and the first level's features."""

    pixels: Tensor
    in_hand: Tensor
    holding: Tensor
    scene: Tensor


class ASR(SpatialQNetwork):
    """Two levels of choices: all pixels, then the yaws at the chosen pixel.

    Both levels share the first level's feature map, so the second level's loss also trains the
    first level's encoder.

    Args:
        positions: (pixels, in_hand, holding) -> (values [B, 1, H, W], scene feature map).
        yaws: (patch [B, 1, p, p], in_hand, scene feature map, holding) -> values [B, yaws].
        levels: pixels and yaws.
        patch_size: rows and columns of the patch around the chosen pixel that the second level
            sees.
    """

    def __init__(
        self, positions: nn.Module, yaws: nn.Module, levels: tuple[Level, Level], patch_size: int
    ) -> None:
        super().__init__()
        self.positions = positions
        self.yaws = yaws
        self.levels = levels
        self.patch_size = patch_size

    def first(self, pixels: Tensor, in_hand: Tensor, holding: Tensor) -> tuple[Tensor, ASRState]:
        """Return the Q values [B, H, W] of the pixels, and the state for `later`."""
        values, scene = self.positions(pixels, in_hand, holding)
        return values.squeeze(1), ASRState(pixels, in_hand, holding, scene)

    def later(self, level: int, state: Any, chosen: Tensor) -> Tensor:
        """Return the Q values [B, yaws] at the chosen pixels [B, 2].

        Raises:
            ValueError: there is no such level.
        """
        if level != 1:
            raise ValueError(f"the later level of this network is 1, got {level}")
        patch = patches(state.pixels, chosen[:, :2], self.patch_size)
        return self.yaws(patch, state.in_hand, state.scene, state.holding)


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


class ASRNetworkConfig(SpatialImageConfig):
    """Hyper-parameters of both ASR networks.

    Args:
        num_rotations: yaws, evenly spaced.
        patch_size: rows and columns of the patch around a pixel that the yaw values depend on; None
            for the size of the in-hand image (24 in the paper). If the two sizes differ, the
            in-hand image is cropped or zero-padded to the patch size about its centre.
    """

    num_rotations: int = Field(default=16, ge=2)
    patch_size: int | None = Field(default=None, ge=1)

    def _layout(self, name: str, spec: SpatialSpec) -> tuple[tuple[Level, Level], int]:
        """Return the levels and the patch's size.

        Raises:
            ValueError: a size does not fit, or the action has other components than x, y and rz.
        """
        require_yaw(name, spec)
        require_unet_size(name, spec.image_size)
        patch_size = self.patch_size or spec.in_hand_size
        if (patch_size - spec.in_hand_size) % 2:
            raise ValueError(
                f"patch_size and in_hand_size must share a centre, so differ by an even number of "
                f"pixels; got {patch_size} and {spec.in_hand_size}"
            )
        pixels = Level(("x", "y"), (spec.image_size, spec.image_size))
        return (pixels, Level(("rz",), (self.num_rotations,))), patch_size


@NETWORKS.register("asr")
class ASRConfig(ASRNetworkConfig):
    """Hyper-parameters of the plain network that chooses a pixel, then a yaw."""

    def build(self, spec: SpatialSpec) -> ASR:
        """Return a freshly initialised network.

        Args:
            spec: shapes and the action's components: x, y and rz.

        Raises:
            ValueError: a size does not fit, or the action has other components.
        """
        levels, patch_size = self._layout("asr", spec)
        positions = PlainPixelValues(spec, self, maps=1)
        yaws = PlainYawValues(spec, self, self.num_rotations, patch_size, positions.scene_channels)
        return ASR(positions, yaws, levels, patch_size)
