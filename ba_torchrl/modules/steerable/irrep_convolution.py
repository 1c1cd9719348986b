"""3x3 steerable convolutions between regular fields with fewer multiplications, on the CPU.

By Schur's lemma, an output irrep only reads the parts of the input that transform as it does. In
the basis of irreps, a 3x3 filter of C_8 therefore needs 84 products per pixel and pair of fields
instead of 576, one of D_4 72 of 576, and one of C_4 36 of 144. The convolution has three steps:
fixed linear maps of each field's neighbourhood (change of basis, harmonics on the rings of the
filter, sums of those that transform equally), matrix products with the weights, and the change of
basis back. The result equals the expanded filter's up to rounding. It is computed for groups
of images, or of rows of an image, whose maps fit the second cache.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ba_torchrl.modules.steerable.cpu_threads import in_parts, refuse_second_derivatives
from ba_torchrl.modules.steerable.irrep_maps import (
    gather_maps,
    scatter_maps,
    to_elements,
    to_irreps,
)
from ba_torchrl.modules.steerable.planar import Representation

CHUNK_BYTES = 1_500_000
"""Largest size of the maps of a group, so that they stay in the second cache."""
LEAST_ROWS = 16
"""Least rows of an image in a group: the rows beside them are read twice."""


class Chunk(NamedTuple):
    """A group of images, or some rows of one image.

    Args:
        images: the images.
        top: first row of the result.
        maps: uninitialised, [M, F, pixels].
        out: uninitialised, [N, out, pixels].
    """

    images: slice
    top: int
    maps: Tensor
    out: Tensor


class Layout:
    """How images lie in one row of pixels, with zeros between them.

    A column of zeros ends each row of an image, and a row of zeros each image, if the convolution
    is padded: one is enough for both neighbours. Images whose maps are too large for the cache are
    computed in groups of rows.

    Args:
        shape: [B, in * N, H, W] of the input.
        maps: number of maps of a field.
        order: number of group elements, N.
        padding: zeros added on each side, pixels.
    """

    def __init__(self, shape: Sequence[int], maps: int, order: int, padding: int) -> None:
        self.maps, self.order = maps, order
        self.fields = shape[1] // order
        self.output = tuple(size + 2 * padding - 2 for size in shape[2:])
        self.rows, self.width = (size + padding for size in shape[2:])

    def chunks(self, part: slice, out_fields: int) -> Iterator[Chunk]:
        """Iterate over the images of a part; the next chunk uses the same memory."""
        rows_that_fit = CHUNK_BYTES // (4 * self.maps * self.fields * self.width)
        step, rows, tops = max(1, rows_that_fit // self.rows), self.rows, [0]
        groups = self.output[0] // max(LEAST_ROWS, rows_that_fit)
        if groups > 1:
            rows = math.ceil(self.output[0] / groups)
            tops = list(range(0, self.output[0], rows))
        shapes = (self.maps, self.fields), (self.order, out_fields)
        memory = [
            torch.empty(
                math.prod(shape) * step * rows * self.width, dtype=torch.float32, device="cpu"
            )
            for shape in shapes
        ]
        for start in range(part.start, part.stop, step):
            images = slice(start, min(start + step, part.stop))
            for top in tops:
                pixels = (images.stop - start) * min(rows, self.rows - top) * self.width
                sizes = [(*shape, pixels) for shape in shapes]
                maps, out = (
                    values[: math.prod(size)].view(size)
                    for values, size in zip(memory, sizes, strict=True)
                )
                yield Chunk(images, top, maps, out)


_TOLERANCE = 1e-5
_LOSS_BY_THREADS = 1.2
"""Duration on several threads relative to oneDNN's, which shares its work among them better."""


@dataclass(frozen=True, eq=False)
class IrrepBlock:
    """Components of output irreps that read the same maps.

    Args:
        first: first row of the output.
        size: number of rows.
        first_map: first map.
        maps: number of maps.
        coupling: float32 [D, size, maps], the entry of each kernel's coefficient.
    """

    first: int
    size: int
    first_map: int
    maps: int
    coupling: Tensor

    def read(self, maps: Tensor) -> Tensor:
        """Return the block's part [maps * in, pixels] of all maps [M, in, pixels]."""
        return maps[self.first_map : self.first_map + self.maps].flatten(0, 1)

    def written(self, out: Tensor) -> Tensor:
        """Return the block's part [size * out, pixels] of the output [N, out, pixels]."""
        return out[self.first : self.first + self.size].flatten(0, 1)


class Terms(NamedTuple):
    """A sparse matrix by rows.

    Args:
        starts: for each row, the position of its first term; one more at the end.
        columns: of each term.
        factors: float32, of each term.
    """

    starts: np.ndarray
    columns: np.ndarray
    factors: np.ndarray

    @classmethod
    def of(cls, matrix: np.ndarray) -> Terms:
        """Return the entries of a matrix that differ from zero by more than rounding."""
        rows, columns = np.nonzero(np.abs(matrix) > _TOLERANCE)
        starts = np.searchsorted(rows, np.arange(len(matrix) + 1))
        return cls(starts, columns, matrix[rows, columns].astype(np.float32))


@dataclass(frozen=True, eq=False)
class IrrepKernels:
    """Kernels between two regular fields in the basis of irreps.

    Args:
        change: float32 [N, N], orthogonal; from group elements to irreps.
        of_maps: for each map, the values that it is a sum of. A value is 9 times the input row
            plus the pattern (see `_patterns`).
        of_values: the same by value, for the gradient.
        blocks: the output irreps.
    """

    change: np.ndarray
    of_maps: Terms
    of_values: Terms
    blocks: tuple[IrrepBlock, ...]

    def __deepcopy__(self, memo: dict) -> IrrepKernels:
        return self  # constant

    @property
    def maps(self) -> int:
        """Number of maps of a field."""
        return len(self.of_maps.starts) - 1

    def gather(self, fields: np.ndarray, padding: int, top: int, maps: Tensor) -> None:
        """Compute maps [M, F, pixels] of fields [n, F, N, H, W] from a row of the result on."""
        gather_maps(fields, self.change, *self.of_maps, padding, top, maps.flatten(0, 1).numpy())

    def scatter(self, maps: Tensor, padding: int, top: int, fields: np.ndarray) -> None:
        """Add the gradient of fields [n, F, N, H, W], from the maps' gradient [M, F, pixels]."""
        scatter_maps(maps.flatten(0, 1).numpy(), self.change, *self.of_values, padding, top, fields)

    def weights(self, coefficients: Tensor) -> list[Tensor]:
        """Return the matrix [size * out, maps * in] of each block.

        Args:
            coefficients: [out, in, D].
        """
        out, fields, _ = coefficients.shape
        columns = coefficients.flatten(0, 1).t().contiguous()
        return [
            (block.coupling.flatten(1).t() @ columns)
            .view(block.size, block.maps, out, fields)
            .transpose(1, 2)
            .reshape(block.size * out, block.maps * fields)
            for block in self.blocks
        ]


def _patterns() -> np.ndarray:
    """Return the orthonormal patterns [9, 9] of a 3x3 neighbourhood that `gather_maps` computes.

    The centre, then for the edges and for the corners: mean, first harmonics, second harmonic.
    """
    rows, columns = (grid.flatten() for grid in np.meshgrid([1, 0, -1], [-1, 0, 1], indexing="ij"))
    angle, radius2 = np.arctan2(rows, columns), rows**2 + columns**2
    found = [1.0 * (radius2 == 0)]
    for ring, offset in ((1, 0.0), (2, np.pi / 4)):
        on = 1.0 * (radius2 == ring)
        found += [on / 2, on * np.cos(angle) / np.sqrt(2), on * np.sin(angle) / np.sqrt(2)]
        found.append(on * np.cos(2 * (angle - offset)) / 2)
    return np.array(found)


def _reduced_rows(matrix: np.ndarray) -> np.ndarray:
    """Return the reduced row echelon form of a matrix without its zero rows."""
    matrix, rank = matrix.copy(), 0
    for column in range(matrix.shape[1]):
        if rank == len(matrix):
            break
        pivot = rank + int(np.abs(matrix[rank:, column]).argmax())
        if abs(matrix[pivot, column]) < _TOLERANCE:
            continue
        matrix[[rank, pivot]] = matrix[[pivot, rank]]
        matrix[rank] /= matrix[rank, column]
        others = np.arange(len(matrix)) != rank
        matrix[others] -= np.outer(matrix[others, column], matrix[rank])
        rank += 1
    return matrix[:rank]


def _changed(kernels: Tensor, change: np.ndarray) -> np.ndarray:
    """Return kernels [D, N, 3, 3, N] as [D, N, 9 N] in a basis of the fields and the patterns."""
    dense = kernels.double().flatten(2, 3).numpy()
    entries = np.einsum("dmsn,am,bn,ps->dabp", dense, change, change, _patterns(), optimize=True)
    return entries.reshape(*entries.shape[:2], -1)


def _groups(entries: np.ndarray) -> list[list[int]]:
    """Return the output rows, grouped by the space of input values that they read."""
    groups: list[list[int]] = []

    def rank(rows: list[int]) -> int:
        return np.linalg.matrix_rank(entries[:, rows].reshape(-1, entries.shape[2]), _TOLERANCE)

    for row in range(entries.shape[1]):
        for group in groups:
            if rank([group[0], row]) == rank([row]) == rank(group[:1]):
                group.append(row)
                break
        else:
            groups.append([row])
    return groups


def irrep_kernels(
    rep: Representation, kernels: Tensor, in_irreps: tuple[Any, ...]
) -> IrrepKernels | None:
    """Return the kernels in the basis of irreps, None where that basis is not orthogonal.

    Args:
        kernels: [D, N, 3, 3, N], input channels last.
        in_irreps: for each of the D kernels, the input irrep that it reads.
    """
    change = np.linalg.inv(rep.change_of_basis)
    change /= np.linalg.norm(change, axis=1, keepdims=True)
    if np.abs(change @ change.T - np.eye(len(change))).max() > _TOLERANCE:
        return None
    groups = _groups(_changed(kernels, change))
    change = change[np.concatenate(groups)]
    entries = _changed(kernels, change)
    maps, blocks = [], []
    for number, size in enumerate(map(len, groups)):
        first, first_map = sum(map(len, groups[:number])), len(maps)
        group = range(first, first + size)
        for source in dict.fromkeys(in_irreps):
            chosen = [d for d, irrep in enumerate(in_irreps) if irrep == source]
            rows = entries[np.ix_(chosen, group)].reshape(-1, entries.shape[2])
            maps += list(_reduced_rows(rows))
        read, written = np.array(maps[first_map:]), entries[:, group]
        coupling = written @ np.linalg.pinv(read)
        assert np.abs(coupling @ read - written).max() < 10 * _TOLERANCE
        coupling[np.abs(coupling) < _TOLERANCE] = 0  # products with denormal numbers are slow
        blocks.append(
            IrrepBlock(
                first=first,
                size=size,
                first_map=first_map,
                maps=len(read),
                coupling=torch.tensor(coupling, dtype=torch.float32),
            )
        )
    return IrrepKernels(
        change=change.astype(np.float32),
        of_maps=Terms.of(np.array(maps)),
        of_values=Terms.of(np.array(maps).T),
        blocks=tuple(blocks),
    )


def saves_time(
    kernels: IrrepKernels,
    size: Sequence[int],
    in_fields: int,
    out_fields: int,
    padding: int,
    threads: int,
) -> bool:
    """Return whether the convolution is estimated to be faster than with the expanded filter.

    A map, a change of basis and a product of small matrices take as long as the numbers of products
    of a large convolution below, on a CPU with AVX-512 (docs/findings.md).

    Args:
        size: height and width of the images.
        in_fields, out_fields: number of fields.
    """
    order = len(kernels.change)
    products = sum(block.size * block.maps for block in kernels.blocks) * in_fields * out_fields
    per_pixel = 2 * (products + order * (210 * in_fields + 40 * out_fields))
    if threads > 1:
        per_pixel *= _LOSS_BY_THREADS
    dense = 9 * order**2 * in_fields * out_fields
    pixels = math.prod(length + padding for length in size)
    return per_pixel * pixels < dense * math.prod(length + 2 * padding - 2 for length in size)


def irrep_convolution(
    x: Tensor, kernels: IrrepKernels, coefficients: Tensor, bias: Tensor | None, padding: int
) -> Tensor:
    """Return the convolution [B, out * N, H', W'] of x [B, in * N, H, W], both float32.

    Args:
        x: regular fields, the channels of a field together.
        coefficients: [out, in, D], of the kernels.
        bias: [out * N].
        padding: zeros added on each side, pixels; at most 2.
    """
    if not len(x) or padding > 2:
        raise ValueError(f"got {len(x)} images, padded by {padding}; the padding is at most 2")
    return _IrrepConvolution.apply(x, kernels, padding, bias, *kernels.weights(coefficients))


class _IrrepConvolution(torch.autograd.Function):
    """The convolution as a function of its input, the bias and the blocks' matrices."""

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        kernels: IrrepKernels,
        padding: int,
        bias: Tensor | None,
        *weights: Tensor,
    ) -> Tensor:
        x = x.contiguous()
        ctx.save_for_backward(x, *weights)
        ctx.kernels, ctx.padding = kernels, padding
        order = len(kernels.change)
        layout = Layout(x.shape, kernels.maps, order, padding)
        fields = weights[0].shape[0] // kernels.blocks[0].size
        y = x.new_empty(len(x), fields * order, *layout.output)
        source = x.unflatten(1, (-1, order)).numpy()
        target = y.unflatten(1, (-1, order)).numpy()
        added = x.new_zeros(fields * order) if bias is None else bias
        added = added.unflatten(0, (fields, order)).contiguous().numpy()

        @torch.no_grad()
        def compute(part: slice) -> None:
            for images, top, maps, out in layout.chunks(part, fields):
                kernels.gather(source[images], padding, top, maps)
                for block, weight in zip(kernels.blocks, weights, strict=True):
                    torch.mm(weight, block.read(maps), out=block.written(out))
                irreps = out.flatten(0, 1).numpy()
                to_elements(irreps, kernels.change, added, layout.width, top, target[images])

        in_parts(len(x), compute)
        return y

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        refuse_second_derivatives()
        x, *weights = ctx.saved_tensors
        kernels = ctx.kernels
        order = len(kernels.change)
        layout = Layout(x.shape, kernels.maps, order, ctx.padding)
        grad = grad.contiguous().unflatten(1, (-1, order))
        fields = grad.shape[1]
        source, arriving = x.unflatten(1, (-1, order)).numpy(), grad.numpy()
        needs_weights = any(ctx.needs_input_grad[4:])
        grad_bias = grad.sum((0, 3, 4)).flatten() if ctx.needs_input_grad[3] else None
        grad_x = torch.zeros_like(x) if ctx.needs_input_grad[0] else None

        @torch.no_grad()
        def compute(part: slice) -> list[Tensor]:
            totals = [torch.zeros_like(weight) for weight in weights]
            for images, top, maps, out in layout.chunks(part, fields):
                irreps = out.flatten(0, 1).numpy()
                to_irreps(arriving[images], kernels.change, layout.width, top, irreps)
                if needs_weights:
                    kernels.gather(source[images], ctx.padding, top, maps)
                    for block, total in zip(kernels.blocks, totals, strict=True):
                        total.addmm_(block.written(out), block.read(maps).t())
                if grad_x is not None:
                    for block, weight in zip(kernels.blocks, weights, strict=True):
                        torch.mm(weight.t(), block.written(out), out=block.read(maps))
                    target = grad_x[images].unflatten(1, (-1, order)).numpy()
                    kernels.scatter(maps, ctx.padding, top, target)
            return totals

        parts = in_parts(len(x), compute)
        totals = [sum(values) for values in zip(*parts, strict=True)] if needs_weights else []
        return grad_x, None, None, grad_bias, *(totals or [None] * len(weights))
