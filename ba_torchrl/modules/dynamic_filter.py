"""Steerable convolutions whose coefficients are computed by another network, one filter per sample.

The inputs of that other network are invariant inputs of the equivariant network. An example is the
in-hand image, which has the gripper's frame and does not rotate with the scene.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.modules.kernel_blocks import (
    KernelBlock,
    bias_expansion,
    he_scales,
    kernel_block,
)

if TYPE_CHECKING:
    from escnn.group import Representation
    from escnn.gspaces import GSpace2D


class DynamicSteerableConv2d(nn.Module):
    """A steerable convolution that takes its coefficients as an input, different for each sample.

    The coefficients are those of the kernels, ordered by output field, input field and kernel,
    followed by one bias for each trivial irrep of the output. The module has no parameters.

    Args:
        gspace: images and their symmetry group.
        representation: of each input field and each output field.
        count: number of fields, in and out.
        kernel_size: pixels; the map keeps its size.
    """

    def __init__(
        self, gspace: GSpace2D, representation: Representation, count: int, kernel_size: int
    ) -> None:
        super().__init__()
        block = kernel_block(gspace, representation, representation, kernel_size)
        assert block is not None  # the identity is always one of them
        self._block = block
        self.count, self.size, self.kernel_size = count, representation.size, kernel_size
        types = [(representation, count)]
        (self._scales,) = he_scales({(0, 0): block}, types, types).values()
        self._bias_block = KernelBlock(bias_expansion(types).t().contiguous(), (), ())
        self.num_weights = count * count * len(block.in_irreps)
        self.num_biases = len(self._bias_block.kernels)

    @property
    def num_coefficients(self) -> int:
        """Number of coefficients of a sample."""
        return self.num_weights + self.num_biases

    def scales(self) -> Tensor:
        """Return the standard deviation that He initialisation gives each coefficient."""
        weights = self._scales.repeat(self.count * self.count)
        return torch.cat([weights, torch.zeros(self.num_biases)])

    def filters(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Return the filters [B, out, in, K, K] and biases [B, out] of coefficients [B, n]."""
        weights, biases = coefficients.split([self.num_weights, self.num_biases], dim=1)
        k, size, count = self.kernel_size, self.size, self.count
        kernels = weights.reshape(-1, len(self._block.in_irreps)) @ self._block.matrix(weights)
        kernels = kernels.view(-1, count, count, size, k, k, size).permute(0, 1, 3, 2, 6, 4, 5)
        filters = kernels.reshape(-1, count * size, count * size, k, k)
        return filters, biases @ self._bias_block.matrix(biases)

    def forward(self, x: Tensor, coefficients: Tensor) -> Tensor:
        """Return the convolutions of x [B, C, H, W] with the filters of coefficients [B, n]."""
        batch, channels, height, width = x.shape
        if not batch:  # a convolution needs at least one group
            return x
        filters, biases = self.filters(coefficients)
        # One grouped convolution for the whole batch, one group of channels per sample.
        # Channels-last takes a tenth of the time of the contiguous layout on CPUs.
        y = F.conv2d(
            x.permute(2, 3, 0, 1).reshape(1, height, width, -1).permute(0, 3, 1, 2),
            filters.flatten(0, 1).to(dtype=x.dtype, memory_format=torch.channels_last),
            biases.flatten().to(x.dtype),
            padding=self.kernel_size // 2,
            groups=batch,
        )
        y = y.permute(2, 3, 1, 0).reshape(height, width, batch, channels).permute(2, 3, 0, 1)
        return y.contiguous(memory_format=torch.channels_last)


def filter_generator(features: int, convolution: DynamicSteerableConv2d) -> nn.Linear:
    """Return a layer from features to the coefficients of a dynamic convolution.

    The layer's biases are He-initialised coefficients, so for zero features the convolution is an
    ordinary freshly initialised layer. For features of unit size, its weights add a term of the
    same standard deviation.

    Args:
        features: number of features.
        convolution: the convolution that uses the coefficients.
    """
    layer = nn.Linear(features, convolution.num_coefficients)
    scales = convolution.scales()
    with torch.no_grad():
        layer.bias.copy_(scales * torch.randn_like(scales))
        layer.weight.copy_(scales[:, None] * torch.randn_like(layer.weight) / features**0.5)
    return layer
