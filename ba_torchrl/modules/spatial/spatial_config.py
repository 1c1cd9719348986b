"""Hyper-parameters of every spatial Q network."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field
from typing_extensions import Self

from ba_torchrl.core import keys
from ba_torchrl.core.choices import Control, Precision
from ba_torchrl.modules.config import MAX_WIDTH, NetworkConfig


class SpatialImageConfig(NetworkConfig):
    """Hyper-parameters of every spatial Q network.

    By default heights are in metres, as in the reference implementation, and a block of 3 cm hardly
    affects the values of a freshly initialised network. With a scale of 0.05 it has a height of
    about one, and learning is faster at the start.

    Args:
        precision: number format of the convolutions, see `compute_dtype`. Values of actions, the
            fully connected layers and the filters' coefficients are always float32.
        height_scale_m: height that is scaled to one. The floor stays zero, like the padding.
        voxel_scale: number of voxels of a projection that is scaled to one.
        width: factor on every layer's width; 1 is the reference's size.
        dense_width: factor on the widths of the hidden fully connected layers; None for `width`.
            They hold most of the parameters of a narrow network.
    """

    control: ClassVar[Control] = "open_loop"
    image_keys: ClassVar[tuple[str, ...]] = (keys.HEIGHTMAP, keys.IN_HAND)
    vector_keys: ClassVar[tuple[str, ...]] = ()

    precision: Precision = "auto"
    height_scale_m: float = Field(default=1.0, gt=0)
    voxel_scale: float = Field(default=1.0, gt=0)
    width: float = Field(default=1.0, gt=0, le=MAX_WIDTH)
    dense_width: float | None = Field(default=None, gt=0, le=MAX_WIDTH)

    def in_voxels(self, pixel_m: float) -> Self:
        """Return a copy that scales heights like projections, whose voxels have the edge
        ``pixel_m``."""
        return self.model_copy(update={"height_scale_m": pixel_m * self.voxel_scale})
