"""Segment trees in NumPy, for where TorchRL's native ones do not load.

TorchRL's prioritised samplers need the trees of its native extension, and no published torchrl
wheel has an extension that loads with torch 2.13; that of 0.14.1 loads with torch 2.14.1.
"""

from __future__ import annotations

from typing import NoReturn

import numpy as np
import torch
from torchrl.data.replay_buffers.samplers import prioritized


class SegmentTree:
    """Leaves with a reduction over any range, updated and searched in batches.

    A binary heap in an array: node i has the children 2 i and 2 i + 1, and the leaves are the
    second half. Values are stored as float64, for sums over many leaves, and returned in ``dtype``.

    As in TorchRL's native trees, the leaves are rounded up to the next power of two, and those
    above ``size`` take values too: a prioritised buffer may hold more items than its sampler's
    ``max_capacity``.

    Args:
        size: number of leaves that are asked for.
    """

    dtype = torch.float64
    reduce = np.add
    identity = 0.0

    def __init__(self, size: int) -> None:
        self.size = int(size)
        """Number of leaves that were asked for, of which a whole range consists."""
        self.capacity = 1 << self.size.bit_length()
        """Number of leaves: the least power of two above `size`."""
        self._nodes = np.full(2 * self.capacity, self.identity)

    def __len__(self) -> int:
        return self.size

    def __getitem__(
        self, index: int | np.ndarray | torch.Tensor
    ) -> float | np.ndarray | torch.Tensor:
        if isinstance(index, int):
            return float(self._nodes[self.capacity + index])
        found = torch.as_tensor(self._nodes[self.capacity + np.asarray(index)], device="cpu")
        found = found.to(self.dtype)
        return found.numpy() if isinstance(index, np.ndarray) else found

    def __setitem__(
        self, index: int | np.ndarray | torch.Tensor, value: float | np.ndarray | torch.Tensor
    ) -> None:
        if isinstance(index, int):
            self._set_leaf(index, float(value))
            return
        node = np.atleast_1d(np.asarray(index)).astype(np.int64)
        if node.size == 0:
            return
        if node.min() < 0 or node.max() >= self.capacity:
            self._refuse_leaf()
        nodes = self._nodes
        node = node + self.capacity
        nodes[node] = np.asarray(value, dtype=np.float64).reshape(-1)
        if 8 * node.size > self.capacity:  # recomputing whole levels is faster than single paths
            level = self.capacity
            while level > 1:
                nodes[level // 2 : level] = self.reduce(
                    nodes[level : 2 * level : 2], nodes[level + 1 : 2 * level : 2]
                )
                level //= 2
            return
        while node[0] > 1:  # all paths have the same length
            node = node >> 1
            nodes[node] = self.reduce(nodes[2 * node], nodes[2 * node + 1])

    def _set_leaf(self, index: int, value: float) -> None:
        """Set one leaf; TorchRL's samplers read a file leaf by leaf."""
        if not 0 <= index < self.capacity:
            self._refuse_leaf()
        nodes = self._nodes
        node = index + self.capacity
        nodes[node] = value
        while node > 1:
            node >>= 1
            nodes[node] = self.reduce(nodes[2 * node], nodes[2 * node + 1])

    def _refuse_leaf(self) -> NoReturn:
        raise IndexError(f"leaf outside [0, {self.capacity})")

    def query(self, start: int, stop: int) -> float:
        """Return the reduction over the leaves [start, stop).

        Args:
            start: first leaf.
            stop: one after the last leaf. From ``start=0``, a stop of `size` or more means all
                leaves.
        """
        nodes = self._nodes
        if start <= 0 and stop >= self.size:
            return float(nodes[1])
        result = self.identity
        left, right = max(start, 0) + self.capacity, min(stop, self.capacity) + self.capacity
        while left < right:
            if left & 1:
                result = self.reduce(result, nodes[left])
                left += 1
            if right & 1:
                right -= 1
                result = self.reduce(result, nodes[right])
            left, right = left >> 1, right >> 1
        return float(result)


class SumTree(SegmentTree):
    """Sums, and the search for the leaf of a uniform draw."""

    def scan_lower_bound(self, mass: float | np.ndarray | torch.Tensor) -> int | torch.Tensor:
        """Return the first leaf whose inclusive prefix sum reaches ``mass``.

        Args:
            mass: in [0, total]; for larger values the result is `size`.
        """
        rest = np.atleast_1d(np.asarray(mass, dtype=np.float64)).copy()
        is_beyond = rest > self._nodes[1]
        node = np.ones(rest.shape, dtype=np.int64)
        while node[0] < self.capacity:
            left = self._nodes[2 * node]
            go_right = rest > left
            rest -= np.where(go_right, left, 0.0)
            node = 2 * node + go_right
        leaf = np.where(is_beyond, self.size, node - self.capacity)
        return int(leaf[0]) if np.ndim(mass) == 0 else torch.as_tensor(leaf, device="cpu")


class MinTree(SegmentTree):
    """Minima."""

    reduce = np.minimum
    identity = np.inf


class SumTreeFp32(SumTree):
    """Sums, returned as float32."""

    dtype = torch.float32


class MinTreeFp32(MinTree):
    """Minima, returned as float32."""

    dtype = torch.float32


_REPLACEMENTS = {
    "SumSegmentTreeFp32": SumTreeFp32,
    "SumSegmentTreeFp64": SumTree,
    "MinSegmentTreeFp32": MinTreeFp32,
    "MinSegmentTreeFp64": MinTree,
}


def use_python_segment_trees() -> None:
    """Give TorchRL's prioritised samplers trees in NumPy if the native trees did not load.

    This sets names of a module of TorchRL. `ExpertPrioritizedSampler` works without it.
    """
    for name, replacement in _REPLACEMENTS.items():
        if getattr(prioritized, name) is None:
            setattr(prioritized, name, replacement)
