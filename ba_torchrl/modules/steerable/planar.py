"""Kernels that are steerable under the rotations, or rotations and reflections, of the plane.

An equivariant kernel K from a field of the representation r to one of s fulfils
K(g x) = s(g) K(x) r(g)^-1 (Weiler and Cesa, "General E(2)-Equivariant Steerable CNNs", 2019).
Between irreps it is a sum over circular harmonics, which couple to both by Clebsch-Gordan
coefficients (Cesa, Lang and Weiler, "A Program to Build E(N)-Equivariant Steerable CNNs", 2022,
theorem 2.1). Order and signs of the kernels are escnn's; a policy's weights are their coefficients.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

IrrepId = tuple[int, ...]
"""Of a cyclic group (frequency,), of a dihedral group (parity under reflections, frequency)."""
_IMAGINARY = np.array([[0.0, -1.0], [1.0, 0.0]])
_PRODUCT = np.array([[1, 0], [0, 1], [0, 1], [-1, 0]]) / np.sqrt(2)
"""Real and imaginary part of the product of two complex numbers, normalised."""
_PRODUCT_WITH_CONJUGATE = np.array([[1, 0], [0, 1], [0, -1], [1, 0]]) / np.sqrt(2)
_LEAST_NORM = 1e-2
"""Squared norm below which a sampled kernel counts as zero."""


@dataclass(frozen=True, eq=False)
class PlanarGroup:
    """The cyclic group of ``order`` rotations, or with ``has_flips`` the dihedral group.

    Use `planar_rotations`, which returns one object for each group.
    """

    order: int
    has_flips: bool

    @property
    def elements(self) -> list[tuple[int, int]]:
        """Elements as (number of reflections, number of rotation steps after them)."""
        flips = range(2 if self.has_flips else 1)
        return [(flip, step) for flip in flips for step in range(self.order)]

    @cached_property
    def irreps(self) -> dict[IrrepId, Representation]:
        """The irreducible representations, by id."""
        most = self.order // 2
        ids: list[IrrepId] = [(k,) for k in range(most + 1)]
        if self.has_flips:
            ids = [(0, 0), *((1, k) for k in range(most + 1))]
            ids += [] if self.order % 2 else [(0, most)]
        return {
            each: Representation(
                self, "irrep_" + ",".join(map(str, each)), (each,), np.eye(self.irrep_size(each))
            )
            for each in dict.fromkeys(ids)
        }

    def irrep(self, *name: int) -> Representation:
        """Return an irreducible representation."""
        return self.irreps[name]

    @property
    def trivial_repr(self) -> Representation:
        """The trivial representation."""
        return next(iter(self.irreps.values()))

    @cached_property
    def regular_repr(self) -> Representation:
        """The permutations of the group's elements."""
        return self._permutations("regular", self.elements, list(self.irreps))

    @cache  # noqa: B019 - groups are kept as well
    def quotient_repr(self, order: int) -> Representation:
        """Return the permutations of the cosets of the rotations of a lower order."""
        if self.has_flips or self.order % order:
            raise ValueError(f"no cosets of {order} rotations among {self.order}")
        irreps = [name for name in self.irreps if name[-1] % order == 0]
        return self._permutations(f"quotient_{order}", self.elements[: self.order // order], irreps)

    def _permutations(
        self, name: str, elements: Sequence[tuple[int, int]], irreps: Sequence[IrrepId]
    ) -> Representation:
        columns, names = [], []
        for irrep in irreps:
            size = self.irrep_size(irrep)
            copies = size if self.has_flips else 1
            names += [irrep] * copies
            for copy in range(copies):
                values = [self.matrix(irrep, element)[:, copy] for element in elements]
                columns.append(np.array(values) * np.sqrt(size / len(elements)))
        return Representation(self, name, tuple(names), np.concatenate(columns, axis=1))

    def irrep_size(self, name: IrrepId) -> int:
        """Return the dimension of an irrep."""
        return 2 if 0 < name[-1] < self.order / 2 else 1

    def matrix(self, name: IrrepId, element: tuple[int, int]) -> np.ndarray:
        """Return the matrix of an irrep at an element."""
        flip, step = element
        angle = 2 * math.pi * name[-1] * step / self.order
        if self.irrep_size(name) == 1:
            sign = -1 if flip and name[0] else 1
            return np.array([[sign * np.cos(angle)]])
        return _rotation(angle) @ np.diag([1, -1 if flip else 1])

    def commuting(self, name: IrrepId) -> list[np.ndarray]:
        """Return a basis of the matrices that commute with an irrep."""
        size = self.irrep_size(name)
        return [np.eye(size), *([] if self.has_flips or size == 1 else [_IMAGINARY])]

    def products(self, first: IrrepId, second: IrrepId) -> list[tuple[IrrepId, np.ndarray]]:
        """Return each irrep in the product of two, and its Clebsch-Gordan coefficients.

        They have the shape [first, second, multiplicity, irrep].
        """
        if self.has_flips:
            found = ((name, self._dihedral_coupling(first, second, name)) for name in self.irreps)
            return [(name, coupling) for name, coupling in found if coupling is not None]
        (m,), (n,) = first, second
        rows, columns = self.irrep_size(first), self.irrep_size(second)
        found = []
        for signed in (m + n,) if rows * columns < 4 else (m - n, m + n):
            j = min(abs(signed), self.order - abs(signed))
            size = self.irrep_size((j,))
            if rows * columns < 4:
                coupling = np.eye(size).reshape(rows, columns, 1, size)
            else:
                coupling = _PRODUCT if signed == m + n else _PRODUCT_WITH_CONJUGATE
                coupling = coupling.reshape(columns, rows, -1, size).transpose(1, 0, 2, 3)
            if j != signed and size == 2:
                coupling = coupling * [1, -1]  # the complex conjugate
            found.append(((j,), coupling))
        return found

    def _dihedral_coupling(
        self, first: IrrepId, second: IrrepId, name: IrrepId
    ) -> np.ndarray | None:
        """The invariant of the product of three irreps, which is unique but for its sign.

        The first entry above half of the largest is positive. None where there is no invariant.
        """
        sizes = [self.irrep_size(each) for each in (first, second, name)]
        mean = np.zeros((math.prod(sizes),) * 2)
        for element in self.elements:
            product = np.ones((1, 1))
            for each in (first, second, name):
                product = np.kron(product, self.matrix(each, element))
            mean += product / len(self.elements)
        if round(np.trace(mean)) == 0:
            return None
        invariant = mean[:, np.argmax(np.diag(mean))]
        invariant = invariant / np.linalg.norm(invariant) * np.sqrt(sizes[2])
        large = np.abs(invariant) > np.abs(invariant).max() / 2
        invariant = invariant * np.sign(invariant[np.argmax(large)])
        return invariant.reshape(*sizes[:2], 1, sizes[2])

    def harmonic(self, frequency: int) -> tuple[list[IrrepId], np.ndarray]:
        """Return the irreps of the circular harmonics of a frequency, and the change of basis.

        Its columns are the irreps' bases, written in (cosine, sine).
        """
        if frequency == 0:
            return [(0, 0) if self.has_flips else (0,)], np.eye(1)
        remainder = frequency % self.order
        k = min(remainder, self.order - remainder)
        change = np.diag([1.0, -1.0]) if 2 * remainder > self.order else np.eye(2)
        name = (1, k) if self.has_flips else (k,)
        names = [name]
        if self.irrep_size(name) == 1:
            names = [(0, k), name] if self.has_flips else [name, name]
        if self.has_flips:
            change = _rotation(frequency * math.pi / 2) @ change  # reflections on a vertical axis
        return names, change


def _rotation(angle_rad: float) -> np.ndarray:
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cosine, -sine], [sine, cosine]])


@dataclass(frozen=True, eq=False)
class Representation:
    """A representation of a group of the plane.

    Args:
        irreps: ids of its irreps, in order.
        change_of_basis: from the irreps, orthogonal.
    """

    group: PlanarGroup
    name: str
    irreps: tuple[IrrepId, ...]
    change_of_basis: np.ndarray

    @property
    def size(self) -> int:
        """Dimension."""
        return len(self.change_of_basis)

    def is_trivial(self) -> bool:
        """Return whether it leaves everything unchanged."""
        return self.size == 1 and not any(self.irreps[0])


def planar_rotations(order: int, *, has_flips: bool = False) -> PlanarGroup:
    """Return the cyclic group C_order of planar rotations, or the dihedral group D_order.

    Examples:
        >>> import torch
        >>> from ba_torchrl.modules import SteerableConv2d, planar_rotations
        >>> c8 = planar_rotations(8)
        >>> layer = SteerableConv2d([(c8.trivial_repr, 1)], [(c8.regular_repr, 2)], kernel_size=3)
        >>> layer(torch.rand(1, 1, 5, 5)).shape
        torch.Size([1, 16, 3, 3])
    """
    return _group(order, has_flips)


_group = cache(PlanarGroup)


def planar_yaws(count: int, half_rotation: bool) -> Representation:
    """Return the representation of the values of ``count`` yaws under planar rotations.

    A rotation by one step moves every value to the next yaw. If yaws half a turn apart are
    equivalent, the steps generate C_2count and half a turn leaves the values unchanged, which is
    the quotient representation C_2count / C_2. Otherwise it is the regular representation of
    C_count.
    """
    if half_rotation:
        return planar_rotations(2 * count).quotient_repr(2)
    return planar_rotations(count).regular_repr


class SampledKernel(NamedTuple):
    """A kernel on a grid of pixels.

    Args:
        values: [out, in, K * K].
        in_irrep: the input irrep that it reads.
        out_index: of the output irrep that it writes.
    """

    values: np.ndarray
    in_irrep: IrrepId
    out_index: int


def sampled_kernels(
    source: Representation, target: Representation, kernel_size: int
) -> list[SampledKernel]:
    """Return the steerable kernels from one representation to another, normalised.

    A frequency above 2 at a ring's radius, and at the outermost one twice the radius, is left out.
    """
    group, found = source.group, []
    rings, widths = _rings(kernel_size)
    frequencies = range(max(_most_frequency(ring, kernel_size) for ring in rings) + 1)
    for frequency in frequencies:
        phase_rad = 0.0 if group.has_flips else math.pi / 2
        harmonics = _circular_harmonics(frequency, kernel_size, phase_rad)
        for start_in, in_irrep in _positions(source):
            for index, (start_out, out_irrep) in enumerate(_positions(target)):
                for coupling in _couplings(group, in_irrep, out_irrep, frequency):
                    for ring, width in zip(rings, widths, strict=True):
                        if frequency > _most_frequency(ring, kernel_size):
                            continue
                        values = coupling @ (harmonics * _ring(ring, width, kernel_size))
                        total = (values**2).sum() / len(coupling)
                        if total**0.5 < 1e-6:
                            continue
                        values = values / total**0.5
                        rows = target.change_of_basis[:, start_out : start_out + len(coupling)]
                        columns = source.change_of_basis[:, start_in : start_in + coupling.shape[1]]
                        values = np.einsum("no,oip,mi->nmp", rows, values, columns)
                        if (values**2).sum() > _LEAST_NORM:
                            found.append(SampledKernel(values, in_irrep, index))
    return found


def _positions(representation: Representation) -> Iterator[tuple[int, IrrepId]]:
    """Yield the first row and the id of each irrep."""
    row = 0
    for name in representation.irreps:
        yield row, name
        row += representation.group.irrep_size(name)


@cache
def _couplings(
    group: PlanarGroup, in_irrep: IrrepId, out_irrep: IrrepId, frequency: int
) -> list[np.ndarray]:
    """Return the matrices [out, in, harmonic] of the kernels of a frequency between two irreps."""
    names, change = group.harmonic(frequency)
    starts = np.cumsum([0, *map(group.irrep_size, names)])
    found = []
    for irrep, coefficients in group.products(out_irrep, in_irrep):
        parts = [
            change[:, start:end].T
            for name, start, end in zip(names, starts, starts[1:], strict=False)
            if name == irrep
        ]
        for commuting in group.commuting(irrep):
            for coupling in np.moveaxis(coefficients, 2, 0):
                found += [coupling @ commuting.T @ part for part in parts]
    return found


def _rings(kernel_size: int) -> tuple[np.ndarray, list[float]]:
    """Return the radii of the rings on which kernels lie, and the rings' widths, in pixels."""
    rings = np.linspace(0, (kernel_size - 1) // 2, math.ceil(kernel_size / 2))
    widths = [0.6] * (len(rings) - 1) + [0.4]
    return rings, [0.005 if ring == 0 else width for ring, width in zip(rings, widths, strict=True)]


def _most_frequency(ring: float, kernel_size: int) -> int:
    """Return the highest frequency that a ring can hold."""
    if ring == 0:
        return 0
    return int(min(2 * ring, 2 if ring == kernel_size // 2 else 2 * ring - (ring + 1) % 2))


def _grid(kernel_size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x to the right and y upwards of each pixel, row by row."""
    steps = np.arange(kernel_size) - (kernel_size - 1) / 2
    return np.tile(steps, kernel_size), -np.repeat(steps, kernel_size)


def _ring(radius: float, width: float, kernel_size: int) -> np.ndarray:
    """Return the values of a Gaussian ring, [K * K]."""
    return np.exp(-0.5 * ((np.hypot(*_grid(kernel_size)) - radius) / width) ** 2)


def _circular_harmonics(frequency: int, kernel_size: int, phase_rad: float) -> np.ndarray:
    """Return cosine and sine of a frequency on the grid, [2, K * K]; of frequency 0, [1, K * K]."""
    x, y = _grid(kernel_size)
    if frequency == 0:
        return np.ones((1, len(x)))
    angle = frequency * (np.arctan2(y, x) - phase_rad)
    return np.stack([np.cos(angle), np.sin(angle)]) * (np.hypot(x, y) > 1e-9)
