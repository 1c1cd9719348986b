"""Fully convolutional Q networks: one value per pixel, or per yaw and pixel (appendix D.1, G.1)."""

from __future__ import annotations

from typing import Any

from pydantic import Field
from torch import Tensor, nn

from ba_torchrl.modules.base import NETWORKS
from ba_torchrl.modules.equi_unet import EquivariantPixelValues
from ba_torchrl.modules.spatial import Level, SpatialQNetwork, SpatialSpec
from ba_torchrl.modules.spatial_inputs import SpatialImageConfig, has_yaw, require_unet_size
from ba_torchrl.modules.steerable import planar_rotations_and_flips, planar_yaws
from ba_torchrl.modules.unet import PlainPixelValues

_DEFAULT_GROUP_ORDER = 4


class FCN(SpatialQNetwork):
    """One level over all pixels, or all yaws and pixels.

    Args:
        values: (pixels, in_hand, holding) -> (values [B, maps, H, W], innermost map).
        image_size: rows and columns of the heightmap.
        num_yaws: number of maps, one per yaw; none for a single map without.
    """

    def __init__(self, values: nn.Module, image_size: int, num_yaws: int | None) -> None:
        super().__init__()
        self.values = values
        pixels = (image_size, image_size)
        if num_yaws is None:
            self.levels = (Level(("x", "y"), pixels),)
        else:
            self.levels = (Level(("rz", "x", "y"), (num_yaws, *pixels)),)

    def first(self, pixels: Tensor, in_hand: Tensor, holding: Tensor) -> tuple[Tensor, Any]:
        """Return the Q values [B, H, W] or [B, yaws, H, W] and no state."""
        values, _ = self.values(pixels, in_hand, holding)
        return values.reshape(-1, *self.levels[0].shape), None


@NETWORKS.register("fcn")
class FCNConfig(SpatialImageConfig):
    """Hyper-parameters of the plain FCN: a UNet with one output map per primitive and yaw.

    Args:
        num_rotations: yaws, evenly spaced; without a yaw in the action it has no meaning.
    """

    num_rotations: int = Field(default=16, ge=2)

    def build(self, spec: SpatialSpec) -> FCN:
        """Return a freshly initialised network.

        Args:
            spec: shapes and the action's components, x, y and perhaps rz.

        Raises:
            ValueError: a size does not fit, or the action has other components.
        """
        num_yaws = self.num_rotations if has_yaw("fcn", spec) else None
        require_unet_size("fcn", spec.image_size)
        return FCN(PlainPixelValues(spec, self, num_yaws or 1), spec.image_size, num_yaws)


@NETWORKS.register("equi_fcn")
class EquiFCNConfig(SpatialImageConfig):
    """Hyper-parameters of the equivariant FCN: turning the image turns the values.

    Without a yaw the symmetry is the dihedral group's. With one it is the cyclic group's that
    contains the step from yaw to yaw, twice as many elements as yaws where those span half a turn.

    Args:
        num_rotations: yaws, evenly spaced; without a yaw in the action it has no meaning.
        group_order: rotations of the dihedral group, 4 unless given; only without a yaw.
    """

    num_rotations: int = Field(default=16, ge=2)
    group_order: int | None = Field(default=None, ge=2)

    def build(self, spec: SpatialSpec) -> FCN:
        """Return a freshly initialised network.

        Args:
            spec: shapes and the action's components, x, y and perhaps rz.

        Raises:
            ImportError: escnn is missing; the message names the fix.
            ValueError: a size does not fit, the action has other components, or a group order is
                given besides a yaw.
        """
        yaw = has_yaw("equi_fcn", spec)
        require_unet_size("equi_fcn", spec.image_size)
        if not yaw:
            gspace = planar_rotations_and_flips(self.group_order or _DEFAULT_GROUP_ORDER)
            values = EquivariantPixelValues(gspace, gspace.trivial_repr, spec, self)
            return FCN(values, spec.image_size, None)
        if self.group_order is not None:
            raise ValueError("num_rotations sets the group of 'equi_fcn': leave out group_order")
        gspace, yaws = planar_yaws(self.num_rotations, spec.half_rotation)
        values = EquivariantPixelValues(gspace, yaws, spec, self)
        return FCN(values, spec.image_size, self.num_rotations)
