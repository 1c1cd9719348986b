"""The equivariant network that chooses a pixel, then a yaw (appendix E, G.1; "Equi ASR")."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.modules.layers import XavierInitialised, scaled_width
from ba_torchrl.modules.spatial.asr import ASR, planar_layout
from ba_torchrl.modules.spatial.base import (
    UNET_STRIDE,
    SpatialSpec,
    dense_width,
    require_yaw,
    scaled_heights,
    scaled_in_hand,
    select_primitive,
)
from ba_torchrl.modules.spatial.equi_asr_config import EquiASRConfig
from ba_torchrl.modules.spatial.equi_unet import EquivariantPixelValues
from ba_torchrl.modules.spatial.in_hand import InHandVector
from ba_torchrl.modules.spatial.views import HeightView
from ba_torchrl.modules.steerable.layers import (
    DynamicSteerableConv2d,
    FilterGenerator,
    SteerableConv2d,
    SteerableLinear,
)
from ba_torchrl.modules.steerable.max_pool import relu_of_max_pool
from ba_torchrl.modules.steerable.planar import Representation, planar_rotations, planar_yaws


class _Stage(NamedTuple):
    fields: int
    kernel_size: int
    padding: int
    pools: bool


_TRUNKS = {
    24: (
        _Stage(8, 7, 2, False),  # 22
        _Stage(16, 7, 2, True),  # 20 -> 10
        _Stage(32, 7, 2, False),  # 8
        _Stage(32, 3, 0, True),  # 6 -> 3
        _Stage(16, 3, 0, False),  # 1
    ),
    40: (
        _Stage(8, 7, 3, True),  # 40 -> 20
        _Stage(16, 7, 3, True),  # 20 -> 10
        _Stage(32, 7, 2, False),  # 8
        _Stage(32, 3, 0, True),  # 6 -> 3
        _Stage(16, 3, 0, False),  # 1
    ),
}
"""Stages from a patch of 24 or 40 pixels to one pixel. Pooling layers have inputs of even size,
which exact equivariance under quarter turns requires."""


SCENE_COPIES = 2
"""Copies of each invariant channel in the reference implementation's scene feature map, whose
later levels then have the 256 input channels of the plain networks."""


class SceneVector(nn.Sequential):
    """A vector of the scene feature map: two linear layers.

    Their input is the maximum and the mean of each channel, so that the vector does not change when
    the map rotates with the scene; with the scene head "flatten", it is the flattened map.

    Args:
        channels: of the map, each invariant except for the positions.
    """

    def __init__(self, channels: int, image_size: int, config: EquiASRConfig) -> None:
        wide, narrow = dense_width(config, 1024), dense_width(config, 512)
        pixels = (image_size // UNET_STRIDE) ** 2
        is_pooled = config.scene_head == "pool"
        inputs = 2 * channels if is_pooled else SCENE_COPIES * channels * pixels
        super().__init__(nn.Linear(inputs, wide), nn.ReLU(), nn.Linear(wide, narrow))
        self.is_pooled = is_pooled
        self.out_features = narrow

    def forward(self, scene: Tensor) -> Tensor:
        """Return float32 [B, out_features] of a map [B, C, h, w]."""
        scene = scene.float()
        if not self.is_pooled:
            return super().forward(scene.repeat(1, SCENE_COPIES, 1, 1).flatten(1))
        largest, mean = scene.amax(dim=(-2, -1)), scene.mean(dim=(-2, -1))
        return super().forward(torch.cat([largest, mean], dim=1))


class EquivariantYawValues(XavierInitialised):
    """Q values of yaws, equivariant under rotations of the patch.

    Vectors of the scene feature map and the in-hand image determine the coefficients of a dynamic
    filter. The values are equivariant under rotations of the whole scene if these are invariant.

    Args:
        out_repr: how the values of the yaws transform.
        config: hyper-parameters, with the units of this module's inputs.
        scene_channels: of the scene feature map.
    """

    def __init__(
        self,
        out_repr: Representation,
        spec: SpatialSpec,
        config: EquiASRConfig,
        patch_size: int,
        scene_channels: int,
    ) -> None:
        super().__init__()
        if patch_size not in _TRUNKS:
            raise ValueError(
                f"equivariant yaw values take a patch_size of {' or '.join(map(str, _TRUNKS))} "
                f"pixels, got {patch_size}; set patch_size if in_hand_size is another"
            )
        self.config = config
        stages = _TRUNKS[patch_size]
        self.pools = tuple(stage.pools for stage in stages)
        self.convs = nn.ModuleList()
        group = out_repr.group
        types = [(group.trivial_repr, 1)]
        for fields, kernel_size, padding, _ in stages:
            # The last layer keeps its full width in narrow networks: with few fields, all outputs
            # of the dynamic filter can be negative, and the gradient after the ReLU is zero.
            width = config.width if len(self.convs) < len(stages) - 1 else max(config.width, 1.0)
            out = [(group.regular_repr, scaled_width(fields, width))]
            self.convs.append(SteerableConv2d(types, out, kernel_size, padding=padding))
            types = out
        ((_, fields),) = types
        self.held = DynamicSteerableConv2d(group.regular_repr, fields, 1)
        self.values = SteerableLinear(types, [(out_repr, 2)])

        narrow, wide = dense_width(config, 512), dense_width(config, 1024)
        self.hand = InHandVector(spec.in_hand_channels, spec.in_hand_size, config.width, wide)
        self.hand_linear = nn.Linear(self.hand.out_features, narrow)
        self.scene = SceneVector(scene_channels, spec.image_size, config)
        self.reset_parameters()
        self.coefficients = FilterGenerator(narrow + self.scene.out_features, self.held)

    def forward(self, patch: Tensor, in_hand: Tensor, scene: Tensor, holding: Tensor) -> Tensor:
        """Return values [B, yaws].

        Args:
            patch: heights around the pixel [B, 1, 1, p, p].
            in_hand: [B, C, h, w].
            scene: [B, scene_channels, h', w'].
            holding: [B, 1], which picks the primitive.
        """
        x = scaled_heights(self.config, patch[:, 0])
        for conv, pool in zip(self.convs, self.pools, strict=True):
            x = conv(x)
            x = relu_of_max_pool(x) if pool else F.relu(x, inplace=True)
        x = F.relu(self.held(x.float(), self._coefficients(in_hand, scene)))
        return select_primitive(self.values(x.flatten(1)), holding)

    def _coefficients(self, in_hand: Tensor, scene: Tensor) -> Tensor:
        hand = self.hand_linear(self.hand(scaled_in_hand(self.config, in_hand)))
        return self.coefficients(F.relu(torch.cat([self.scene(scene), hand], dim=1)))


def pixels_and_yaws(
    config: EquiASRConfig, spec: SpatialSpec, yaw_config: EquiASRConfig, patch_size: int
) -> tuple[EquivariantPixelValues, tuple[HeightView, EquivariantYawValues]]:
    """Return the values of the pixels, and the yaws' values with their view."""
    group = planar_rotations(config.group_order, has_flips=True)
    positions = EquivariantPixelValues(group.trivial_repr, spec, config)
    yaw_repr = planar_yaws(config.num_rotations, spec.half_rotation)
    channels = positions.scene_channels
    yaws = EquivariantYawValues(yaw_repr, spec, yaw_config, patch_size, channels)
    return positions, (HeightView(patch_size), yaws)


def build_equi_asr(config: EquiASRConfig, spec: SpatialSpec) -> ASR:
    """Return a freshly initialised network for x, y and rz."""
    require_yaw("equi_asr", spec)
    levels, patch_size = planar_layout(config, "equi_asr", spec)
    positions, yaws = pixels_and_yaws(config, spec, config, patch_size)
    return ASR(positions, [yaws], levels)
