"""The equivariant actor-critic with strided convolutions instead of max pools.

Not part of the paper. A 4x4 kernel with stride 2 reads pixels that are symmetric about the centre
of the image, so that quarter turns remain exact; a 3x3 kernel with stride 2 does not. It takes four
products per input pixel and pair of channels where a 3x3 kernel before a max pool takes nine.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ba_torchrl.modules.base import NETWORKS
from ba_torchrl.modules.equivariant import EquivariantConfig
from ba_torchrl.modules.steerable import FieldTypes, SteerableConv2d

if TYPE_CHECKING:
    from escnn.gspaces import GSpace2D


@NETWORKS.register("equi_strided")
class StridedEquivariantConfig(EquivariantConfig):
    """Hyper-parameters of the equivariant actor-critic with strided convolutions.

    The stages, their numbers of fields and the arguments are those of `EquivariantConfig`.
    """

    def _convolution(
        self, gspace: GSpace2D, inputs: FieldTypes, outputs: FieldTypes, padding: int, pools: bool
    ) -> SteerableConv2d:
        size, stride = (4, 2) if pools else (3, 1)
        return SteerableConv2d(gspace, inputs, outputs, size, padding=padding, stride=stride)
