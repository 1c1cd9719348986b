"""Bases of steerable kernels as tensors, and scales of their initial coefficients."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ba_torchrl.modules.layers import can_be_kept, real_tensors
from ba_torchrl.modules.steerable.irrep_convolution import IrrepKernels, irrep_kernels
from ba_torchrl.modules.steerable.planar import Representation, sampled_kernels

FieldTypes = Sequence[tuple[Representation, int]]
"""Representations with their multiplicities, in the order of the channels."""


@dataclass(frozen=True, eq=False)
class KernelBlock:
    """The steerable kernels between one input and one output representation.

    Args:
        kernels: float32 [D, O, K, K, I], normalised, input channels last.
        in_irreps: for each of the D kernels, the input irrep that it reads.
        out_irreps: for each kernel, the index of the output irrep that it writes.
    """

    kernels: Tensor
    in_irreps: tuple[Any, ...]
    out_irreps: tuple[int, ...]
    _copies: dict[tuple[torch.device, torch.dtype], Tensor] = field(default_factory=dict)

    def __deepcopy__(self, memo: dict) -> KernelBlock:
        return self  # constant, shared by every layer of the process

    def __getstate__(self) -> dict:
        return {**self.__dict__, "_copies": {}}

    def matrix(self, like: Tensor) -> Tensor:
        """Return the kernels as [D, O*K*K*I] on the device and in the dtype of ``like``."""
        key = (like.device, like.dtype)
        if key not in self._copies:
            with torch.inference_mode(False):  # for later training steps
                copy = self.kernels.flatten(1).to(device=like.device, dtype=like.dtype)
            if not can_be_kept(copy):
                return copy
            self._copies[key] = copy
        return self._copies[key]


@cache
@real_tensors
def kernel_block(
    in_repr: Representation, out_repr: Representation, kernel_size: int
) -> KernelBlock | None:
    """Return the kernels between two representations, None if there are none.

    Built once per process: the construction takes up to a second for large groups.
    """
    if in_repr.group is not out_repr.group:
        raise ValueError("input and output fields must be of one group of `planar_rotations`")
    found = sampled_kernels(in_repr, out_repr, kernel_size)
    if not found:
        return None  # for example trivial to vector with a 1x1 kernel
    kernels = torch.tensor(np.stack([kernel.values for kernel in found]), dtype=torch.float32)
    kernels = kernels.unflatten(-1, (kernel_size, kernel_size)).permute(0, 1, 3, 4, 2)
    return KernelBlock(
        kernels=kernels.contiguous(),
        in_irreps=tuple(kernel.in_irrep for kernel in found),
        out_irreps=tuple(kernel.out_index for kernel in found),
    )


@cache
@real_tensors
def regular_irrep_kernels(rep: Representation) -> IrrepKernels | None:
    """Return the 3x3 kernels between fields of a representation in the basis of irreps."""
    block = kernel_block(rep, rep, 3)
    return None if block is None else irrep_kernels(rep, block.kernels, block.in_irreps)


def he_scales(
    blocks: dict[tuple[int, int], KernelBlock], in_types: FieldTypes, out_types: FieldTypes
) -> dict[tuple[int, int], Tensor]:
    """Return the standard deviation of each kernel's coefficients, for every pair of types.

    The generalised He initialisation (Weiler and Cesa, "General E(2)-equivariant steerable
    CNNs", 2019): every input irrep that feeds an output irrep contributes equally, and so does
    every kernel from it. The values are the same for all fields of a type.

    Args:
        blocks: kernels of each pair (input type, output type) that has kernels.
    """
    sources: dict[tuple[int, int], set] = defaultdict(set)
    kernels: Counter = Counter()
    for (i, o), block in blocks.items():
        for source, target in zip(block.in_irreps, block.out_irreps, strict=True):
            sources[o, target].add(source)
            kernels[source, o, target] += in_types[i][1]
    return {
        (i, o): torch.tensor(
            [
                1 / math.sqrt(len(sources[o, target]) * kernels[source, o, target])
                for source, target in zip(block.in_irreps, block.out_irreps, strict=True)
            ],
            device="cpu",  # with values, where the layer is made on the meta device
        )
        for (i, o), block in blocks.items()
    }


@real_tensors
def bias_block(out_types: FieldTypes) -> KernelBlock:
    """Return the kernels [biases, channels] of biases, which act on trivial irreps, mapped into the
    bases of their fields."""
    columns, channels = [], sum(rep.size * count for rep, count in out_types)
    start = 0
    for rep, count in out_types:
        position, trivial = 0, []
        for name in rep.irreps:
            if not any(name):
                trivial.append(torch.tensor(rep.change_of_basis[:, position], dtype=torch.float32))
            position += rep.group.irrep_size(name)
        for _ in range(count):
            for values in trivial:
                column = torch.zeros(channels)
                column[start : start + rep.size] = values
                columns.append(column)
            start += rep.size
    return KernelBlock(torch.stack(columns) if columns else torch.zeros(0, channels), (), ())
