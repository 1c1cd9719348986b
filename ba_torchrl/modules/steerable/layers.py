"""Steerable convolutions with plain tensors in and out.

The layers hold the coefficients of the kernels and expand them in every forward pass, or once
inside `reuse_filters`. Outside of it no filter is kept, so none is outdated when weights are copied
in place, and ``state_dict``, ``deepcopy`` and functional calls see ordinary parameters only.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.modules.layers import can_be_kept
from ba_torchrl.modules.steerable.cpu_threads import is_plain_float32
from ba_torchrl.modules.steerable.irrep_convolution import (
    IrrepKernels,
    irrep_convolution,
    saves_time,
)
from ba_torchrl.modules.steerable.kernels import (
    FieldTypes,
    bias_block,
    he_scales,
    kernel_block,
    regular_irrep_kernels,
)
from ba_torchrl.modules.steerable.planar import Representation

_expanded: ContextVar[dict[tuple[Any, ...], tuple[Any, ...]] | None] = ContextVar(
    "expanded", default=None
)
"""Inside `reuse_filters`: filters with their weights, by layer, dtype, autocasting and ids of the
weights."""


@contextlib.contextmanager
def reuse_filters() -> Iterator[None]:
    """Expand each filter once inside the context, in which no weight may change.

    For evaluation, where the weights are constant and batches small. Forward passes with gradients
    expand their filters as usual, and so does code that is compiled or exported.
    """
    if torch.compiler.is_compiling():  # which traces no context variable
        yield
        return
    token = _expanded.set({})
    try:
        yield
    finally:
        _expanded.reset(token)


class SteerableConv2d(nn.Module):
    """A convolution whose filter is a learnt combination of steerable kernels.

    Numerically it is escnn's ``R2Conv`` with default bands. Equivariant under the fields' group,
    exactly so for multiples of 90 degrees if the pixels that ``stride`` reads have that symmetry.

    Args:
        in_types: input fields as (representation, multiplicity); each representation once. The
            representations are those of a group of `planar_rotations`.
        out_types: output fields likewise.
        padding: zeros added on each side, pixels.
        stride: distance between output pixels, in input pixels.
    """

    def __init__(
        self,
        in_types: FieldTypes,
        out_types: FieldTypes,
        kernel_size: int,
        *,
        padding: int = 0,
        stride: int = 1,
    ) -> None:
        super().__init__()
        for types in (in_types, out_types):
            names = [rep.name for rep, _ in types]
            if len(set(names)) != len(names) or any(count < 1 for _, count in types):
                raise ValueError(
                    "list each representation once, with a multiplicity of at least one; got "
                    + ", ".join(f"{count} x {rep.name}" for rep, count in types)
                )
        self.kernel_size = kernel_size
        self.padding = padding
        self.stride = stride
        self._in = [(rep.size, count) for rep, count in in_types]
        self._out = [(rep.size, count) for rep, count in out_types]
        found = {
            (i, o): kernel_block(in_repr, out_repr, kernel_size)
            for i, (in_repr, _) in enumerate(in_types)
            for o, (out_repr, _) in enumerate(out_types)
        }
        # Neither parameters nor buffers, because they are constant: soft updates of target
        # networks, checkpoints and optimisers must not contain them.
        self._blocks = {pair: block for pair, block in found.items() if block is not None}
        if not self._blocks:
            raise ValueError("no steerable kernel maps these input fields to these output fields")
        scales = he_scales(self._blocks, in_types, out_types)
        self._scales = {self._name(pair): scale for pair, scale in scales.items()}
        self.coefficients = nn.ParameterDict(
            {
                self._name((i, o)): nn.Parameter(
                    torch.empty(self._out[o][1], self._in[i][1], len(scale))
                )
                for (i, o), scale in scales.items()
            }
        )
        self._irrep_kernels = None
        if list(self._blocks) == [(0, 0)] and (kernel_size, stride) == (3, 1) and padding <= 2:
            ((in_repr, _), *others), ((out_repr, _), *other_outputs) = in_types, out_types
            is_small = in_repr.size <= 8  # kernels of large groups take seconds to convert
            if in_repr is out_repr and is_small and not others and not other_outputs:
                self._irrep_kernels = regular_irrep_kernels(in_repr)
        self._bias_block = bias_block(out_types)
        count = len(self._bias_block.kernels)
        self.bias = nn.Parameter(torch.empty(count)) if count else None
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """He-initialise the coefficients, and set the biases to zero."""
        for name, scale in self._scales.items():
            coefficients = self.coefficients[name]
            coefficients.copy_(scale * torch.randn(coefficients.shape, device=scale.device))
        if self.bias is not None:
            self.bias.zero_()

    @staticmethod
    def _name(pair: tuple[int, int]) -> str:
        return f"in{pair[0]}_out{pair[1]}"

    def expand(self, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor | None]:
        """Return the filter [out, in, K, K], channels-last, and the bias [out], from the weights.

        Args:
            dtype: of the result and of the computation; sums are accumulated in float32 or better.
        """
        rows = [
            torch.cat([self._expand_pair((i, o), dtype) for i in range(len(self._in))], dim=-1)
            for o in range(len(self._out))
        ]
        weight = torch.cat(rows, dim=0) if len(rows) > 1 else rows[0]
        bias = self.expand_bias()
        return weight.permute(0, 3, 1, 2), None if bias is None else bias.to(dtype)

    def expand_bias(self) -> Tensor | None:
        """Return the bias of the expanded filter, float32 [out channels], None if there is none."""
        return None if self.bias is None else self.bias @ self._bias_block.matrix(self.bias)

    def _expand_pair(self, pair: tuple[int, int], dtype: torch.dtype) -> Tensor:
        """Return one block of the filter, [out channels, K, K, in channels]."""
        (in_size, in_count), (out_size, out_count) = self._in[pair[0]], self._out[pair[1]]
        k = self.kernel_size
        if pair not in self._blocks:
            some = next(iter(self.coefficients.values()))
            return some.new_zeros((out_count * out_size, k, k, in_count * in_size), dtype=dtype)
        # In the dtype of the convolution: in float32 the expansion takes longer than the
        # convolution for 7x7 kernels of C_32. Rounding to bfloat16 keeps the symmetry of the
        # kernels.
        coefficients = self.coefficients[self._name(pair)].to(dtype)
        kernels = coefficients.flatten(0, 1) @ self._blocks[pair].matrix(coefficients)
        kernels = kernels.view(out_count, in_count, out_size, k, k, in_size)
        return kernels.permute(0, 2, 3, 4, 1, 5).reshape(out_count * out_size, k, k, -1)

    def filters(self, dtype: torch.dtype) -> tuple[Tensor, Tensor | None]:
        """Return the result of `expand`, which `reuse_filters` keeps for further calls."""
        if torch.is_grad_enabled() or torch.compiler.is_compiling():
            return self.expand(dtype)
        kept = _expanded.get()
        if kept is None:
            return self.expand(dtype)
        # The tensors that a functional call puts in place of the parameters have other ids; they
        # are kept with the result, so that no id is used again.
        weights = tuple(self.parameters())
        is_autocast = torch.is_autocast_enabled(weights[0].device.type)
        key = (self, dtype, is_autocast, *map(id, weights))
        if key not in kept:
            filters = self.expand(dtype)
            if not can_be_kept(filters[0]):
                return filters
            kept[key] = (filters, weights)
        return kept[key][0]

    def forward(self, x: Tensor) -> Tensor:
        """Return the convolution of x [B, C, H, W], computed in x's dtype."""
        kernels = self._faster_kernels(x)
        if kernels is not None:
            (coefficients,) = self.coefficients.values()
            return irrep_convolution(x, kernels, coefficients, self.expand_bias(), self.padding)
        weight, bias = self.filters(x.dtype)
        return F.conv2d(x, weight, bias, self.stride, self.padding)

    def _faster_kernels(self, x: Tensor) -> IrrepKernels | None:
        """Return the kernels in the basis of irreps where they compute the convolution faster."""
        if (
            self._irrep_kernels is None
            or x.dim() != 4
            or not is_plain_float32(x)
            or (_expanded.get() is not None and not torch.is_grad_enabled())  # filters are kept
        ):
            return None
        if any(weight.dtype != x.dtype for weight in self.parameters()):
            return None
        ((_, in_count),), ((_, out_count),) = self._in, self._out
        is_faster = saves_time(
            self._irrep_kernels,
            x.shape[2:],
            in_count,
            out_count,
            self.padding,
            torch.get_num_threads(),
        )
        return self._irrep_kernels if is_faster else None

    def extra_repr(self) -> str:
        """Return the sizes for ``print``."""
        sizes = f"kernel_size={self.kernel_size}, stride={self.stride}"
        return f"in={self._in}, out={self._out}, {sizes}"


class SteerableLinear(SteerableConv2d):
    """An equivariant linear layer between vectors of fields: a one-pixel `SteerableConv2d`."""

    def __init__(self, in_types: FieldTypes, out_types: FieldTypes) -> None:
        super().__init__(in_types, out_types, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return [..., out] of x [..., in]."""
        weight, bias = self.filters(x.dtype)
        return F.linear(x, weight[:, :, 0, 0], bias)


class DynamicSteerableConv2d(nn.Module):
    """A steerable convolution that takes its coefficients as an input, different for each sample.

    Another network computes them from invariants, such as the in-hand image, which has the
    gripper's frame and does not rotate with the scene.

    The coefficients belong to the kernels, ordered by output field, input field and kernel,
    followed by one bias for each trivial irrep of the output. The module has no parameters.

    Args:
        representation: of each input field and each output field.
        count: number of fields, in and out.
        kernel_size: pixels; the map keeps its size.
    """

    def __init__(self, representation: Representation, count: int, kernel_size: int) -> None:
        super().__init__()
        block = kernel_block(representation, representation, kernel_size)
        assert block is not None  # the identity is always one of them
        self._block = block
        self.count, self.size, self.kernel_size = count, representation.size, kernel_size
        types = [(representation, count)]
        (self._scales,) = he_scales({(0, 0): block}, types, types).values()
        self._bias_block = bias_block(types)
        self.num_weights = count * count * len(block.in_irreps)
        self.num_biases = len(self._bias_block.kernels)

    @property
    def num_coefficients(self) -> int:
        """Number of coefficients of a sample."""
        return self.num_weights + self.num_biases

    def scales(self) -> Tensor:
        """Return the standard deviation that He initialisation gives each coefficient."""
        weights = self._scales.repeat(self.count * self.count)
        return torch.cat([weights, torch.zeros(self.num_biases, device=weights.device)])

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


class FilterGenerator(nn.Linear):
    """A layer from features to the coefficients of a dynamic convolution.

    The layer's biases are He-initialised coefficients, so for zero features the convolution is an
    ordinary freshly initialised layer. For features of unit size, its weights add a term of the
    same standard deviation.
    """

    def __init__(self, features: int, convolution: DynamicSteerableConv2d) -> None:
        self._scales = convolution.scales()
        super().__init__(features, convolution.num_coefficients)

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draw weights and biases of the coefficients' standard deviations."""
        super().reset_parameters()  # whose draws the seeds of records include
        scales = self._scales
        self.bias.copy_(scales * torch.randn_like(scales))
        weight = scales[:, None] * torch.randn(self.weight.shape, device=scales.device)
        self.weight.copy_(weight / self.in_features**0.5)
