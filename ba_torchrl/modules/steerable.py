"""Steerable convolutions on escnn's kernel bases, with plain tensors in and out.

escnn builds the bases; the layers here hold the coefficients and expand them in every forward
pass, or once inside `reuse_filters`. Outside of it no filter is kept, so none is outdated when
weights are copied in place, and ``state_dict``, ``deepcopy`` and functional calls see ordinary
parameters only.
"""

from __future__ import annotations

import contextlib
import io
import math
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

if TYPE_CHECKING:
    from types import ModuleType

    from escnn.group import Representation
    from escnn.gspaces import GSpace2D

FieldTypes = Sequence[tuple["Representation", int]]
"""Representations with their multiplicities, in the order of the channels."""

ESCNN_FIX = (
    "equivariant networks need escnn; install it without its Fortran dependency by "
    "`pip install --no-deps escnn==1.0.11 && pip install lie_learn joblib pymanopt autograd`, "
    "or run `make setup`"
)


_expanded: ContextVar[dict[tuple[Any, ...], tuple[Any, ...]] | None] = ContextVar(
    "expanded", default=None
)
"""Inside `reuse_filters`: filters with their weights, by layer, dtype and ids of the weights."""


@contextlib.contextmanager
def reuse_filters() -> Iterator[None]:
    """Expand each filter once inside the context, in which no weight may change.

    For evaluation, where the weights are constant and batches small. Forward passes with gradients
    expand their filters as usual.
    """
    token = _expanded.set({})
    try:
        yield
    finally:
        _expanded.reset(token)


def _gspaces() -> ModuleType:
    try:
        with warnings.catch_warnings():
            # escnn warns that the SO(3) package is missing; planar groups do not need it.
            warnings.filterwarnings("ignore", message=".*py3nj")
            from escnn import gspaces
    except ImportError as error:
        raise ImportError(ESCNN_FIX) from error
    return gspaces


def planar_rotations(order: int) -> GSpace2D:
    """Return escnn's space of planar images under the rotations of the cyclic group C_order.

    Args:
        order: number of rotations.

    Raises:
        ImportError: escnn is not installed; the message names the fix.
    """
    return _gspaces().rot2dOnR2(order)


def planar_rotations_and_flips(order: int) -> GSpace2D:
    """Return escnn's space of planar images under the dihedral group D_order.

    Args:
        order: number of rotations; with the reflections the group has twice as many elements.

    Raises:
        ImportError: escnn is not installed; the message names the fix.
    """
    return _gspaces().flipRot2dOnR2(order)


def planar_yaws(count: int, half_rotation: bool) -> tuple[GSpace2D, Representation]:
    """Return the planar rotations, and the representation of the values of ``count`` yaws.

    A rotation by one step moves every value to the next yaw. If yaws half a turn apart are
    equivalent, the steps generate C_2count and half a turn leaves the values unchanged, which is
    the quotient representation C_2count / C_2. Otherwise it is the regular representation of
    C_count.

    Args:
        count: number of yaws, evenly spaced.
        half_rotation: whether the yaws span half a turn.

    Raises:
        ImportError: escnn is not installed; the message names the fix.
    """
    if half_rotation:
        gspace = planar_rotations(2 * count)
        return gspace, gspace.quotient_repr(2)
    gspace = planar_rotations(count)
    return gspace, gspace.regular_repr


@dataclass(frozen=True, eq=False)
class KernelBlock:
    """The steerable kernels between one input and one output representation.

    Args:
        kernels: float32 [D, O, K, K, I], escnn's normalised basis, input channels last.
        in_irreps: for each of the D kernels, the input irrep that it reads.
        out_irreps: for each kernel, the position of the output irrep that it writes.
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
            self._copies[key] = self.kernels.flatten(1).to(like)
        return self._copies[key]


_BLOCKS: dict[tuple, KernelBlock | None] = {}


def kernel_block(
    gspace: GSpace2D, in_repr: Representation, out_repr: Representation, kernel_size: int
) -> KernelBlock | None:
    """Return the kernels between two representations, None if there are none.

    Built once per process: escnn's construction takes up to a second for large groups.

    Args:
        gspace: images and their symmetry group.
        in_repr: representation of the input field.
        out_repr: representation of the output field.
        kernel_size: pixels.
    """
    key = (gspace, in_repr.name, out_repr.name, kernel_size)
    if key not in _BLOCKS:
        _BLOCKS[key] = _build_block(gspace, in_repr, out_repr, kernel_size)
    return _BLOCKS[key]


def _build_block(
    gspace: GSpace2D, in_repr: Representation, out_repr: Representation, kernel_size: int
) -> KernelBlock | None:
    from escnn.nn import FieldType, R2Conv

    types = FieldType(gspace, [in_repr]), FieldType(gspace, [out_repr])
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # escnn prints when the basis is empty
            layer = R2Conv(*types, kernel_size, initialize=False)
    except ValueError as error:
        if "basis" in str(error) and "empty" in str(error):
            return None  # for example trivial to vector with a 1x1 kernel
        raise
    expansion = layer.basisexpansion
    # One pair of representations has one buffer. Expanding unit vectors gives the same numbers, but
    # takes almost a minute for 7x7 kernels of C_32.
    (kernels,) = (v for n, v in expansion.named_buffers() if n.endswith("sampled_basis"))
    shape = (-1, out_repr.size, in_repr.size, kernel_size, kernel_size)
    info = list(expansion.get_basis_info())
    return KernelBlock(
        kernels=kernels.reshape(shape).permute(0, 1, 3, 4, 2).contiguous().float(),
        in_irreps=tuple(entry["in_irrep"] for entry in info),
        out_irreps=tuple(entry["out_irreps_position"] for entry in info),
    )


def he_scales(
    blocks: dict[tuple[int, int], KernelBlock], in_types: FieldTypes, out_types: FieldTypes
) -> dict[tuple[int, int], Tensor]:
    """Return the standard deviation of each kernel's coefficients, for every pair of types.

    The generalised He initialisation (Weiler and Cesa, "General E(2)-equivariant steerable
    CNNs", 2019): every input irrep that feeds an output irrep contributes equally, and so does
    every kernel from it. The values are the same for all fields of a type.

    Args:
        blocks: kernels of each pair (input type, output type) that has kernels.
        in_types: input fields.
        out_types: output fields.
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
            ]
        )
        for (i, o), block in blocks.items()
    }


def bias_expansion(out_types: FieldTypes) -> Tensor:
    """Return [channels, biases]: a bias acts on a trivial irrep, mapped into its field's basis."""
    columns, channels = [], sum(rep.size * count for rep, count in out_types)
    start = 0
    for rep, count in out_types:
        position, trivial = 0, []
        for irrep in (rep.group.irrep(*name) for name in rep.irreps):
            if irrep.is_trivial():
                trivial.append(torch.tensor(rep.change_of_basis[:, position], dtype=torch.float32))
            position += irrep.size
        for _ in range(count):
            for values in trivial:
                column = torch.zeros(channels)
                column[start : start + rep.size] = values
                columns.append(column)
            start += rep.size
    return torch.stack(columns, dim=1) if columns else torch.zeros(channels, 0)


class SteerableConv2d(nn.Module):
    """A convolution whose filter is a learnt combination of steerable kernels.

    Numerically it is escnn's ``R2Conv`` with default bands. Equivariant under the rotations of
    ``gspace``, exactly so for multiples of 90 degrees.

    Args:
        gspace: images and their symmetry group.
        in_types: input fields as (representation, multiplicity); each representation once.
        out_types: output fields likewise.
        kernel_size: pixels.
        padding: zeros added on each side, pixels.
        bias: one bias per trivial irrep of the output.

    Raises:
        ValueError: a representation is listed twice, a multiplicity is below one, or no kernel
            maps ``in_types`` to ``out_types``.
    """

    def __init__(
        self,
        gspace: GSpace2D,
        in_types: FieldTypes,
        out_types: FieldTypes,
        kernel_size: int,
        *,
        padding: int = 0,
        bias: bool = True,
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
        self._in = [(rep.size, count) for rep, count in in_types]
        self._out = [(rep.size, count) for rep, count in out_types]
        found = {
            (i, o): kernel_block(gspace, in_repr, out_repr, kernel_size)
            for i, (in_repr, _) in enumerate(in_types)
            for o, (out_repr, _) in enumerate(out_types)
        }
        # Neither parameters nor buffers, because they are constant: soft updates of target
        # networks, checkpoints and optimisers must not contain them.
        self._blocks = {pair: block for pair, block in found.items() if block is not None}
        if not self._blocks:
            raise ValueError("no steerable kernel maps these input fields to these output fields")
        scales = he_scales(self._blocks, in_types, out_types)
        self.coefficients = nn.ParameterDict(
            {
                self._name(pair): nn.Parameter(
                    scale * torch.randn(self._out[pair[1]][1], self._in[pair[0]][1], len(scale))
                )
                for pair, scale in scales.items()
            }
        )
        expansion = bias_expansion(out_types)
        self._bias_block = KernelBlock(expansion.t().contiguous(), (), ())
        count = expansion.shape[1]
        self.bias = nn.Parameter(torch.zeros(count)) if bias and count else None

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
        bias = None
        if self.bias is not None:
            bias = (self.bias @ self._bias_block.matrix(self.bias)).to(dtype)
        return weight.permute(0, 3, 1, 2), bias

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
        """As `expand`, but from `reuse_filters` where it applies."""
        if torch.is_grad_enabled() or torch.compiler.is_compiling():
            return self.expand(dtype)
        kept = _expanded.get()
        if kept is None:
            return self.expand(dtype)
        # The tensors that a functional call puts in place of the parameters have other ids; they
        # are kept with the result, so that no id is used again.
        weights = tuple(self.parameters())
        key = (self, dtype, *map(id, weights))
        if key not in kept:
            kept[key] = (self.expand(dtype), weights)
        return kept[key][0]

    def forward(self, x: Tensor) -> Tensor:
        """Return the convolution of x [B, C, H, W], computed in x's dtype."""
        weight, bias = self.filters(x.dtype)
        return F.conv2d(x, weight, bias, padding=self.padding)

    def extra_repr(self) -> str:
        """Return the sizes for ``print``."""
        return f"in={self._in}, out={self._out}, kernel_size={self.kernel_size}"


class SteerableLinear(SteerableConv2d):
    """The steerable map between vectors of fields: a one-pixel steerable convolution.

    Args:
        gspace: images and their symmetry group.
        in_types: input fields as (representation, multiplicity); each representation once.
        out_types: output fields likewise.
        bias: one bias per trivial irrep of the output.
    """

    def __init__(
        self, gspace: GSpace2D, in_types: FieldTypes, out_types: FieldTypes, *, bias: bool = True
    ) -> None:
        super().__init__(gspace, in_types, out_types, 1, bias=bias)

    def forward(self, x: Tensor) -> Tensor:
        """Return [..., out] of x [..., in]."""
        weight, bias = self.filters(x.dtype)
        return F.linear(x, weight[:, :, 0, 0], bias)
