"""A table of compressed images that stores equal images once."""

from __future__ import annotations

import sys
import zlib
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

_LEVEL = 1
"""Level of zlib: it compresses rendered depth fifty-fold, and higher ones gain little."""
_BYTES_PER_FRAME = 100
"""Memory of a frame's slot, count and index entry in CPython, without the compressed frame."""


class FrameTable:
    """Reference-counted uint8 frames, compressed and indexed by their content.

    Equal frames share a slot, such as the next image of a step and the image of the following step,
    in any order of insertion. Incompressible frames take their full size.

    Args:
        shape: of one frame.
    """

    def __init__(self, shape: torch.Size) -> None:
        self.shape = torch.Size(shape)
        self.clear()

    def clear(self) -> None:
        """Remove every frame."""
        self._packed: list[bytes] = []  # by slot; empty where free
        self._counts: list[int] = []
        self._free: list[int] = []
        self._slots: dict[bytes, int] = {}
        self._packed_bytes = 0

    def __len__(self) -> int:
        """Number of stored frames."""
        return len(self._slots)

    @property
    def nbytes(self) -> int:
        """Bytes of memory in use, including Python's objects."""
        return self._packed_bytes + _BYTES_PER_FRAME * len(self._packed)

    def acquire(self, frame: np.ndarray) -> int:
        """Return the slot of a frame, stored if it is new, and increment the count of its uses.

        Args:
            frame: uint8 of one frame's size, flat and contiguous.
        """
        packed = zlib.compress(frame, _LEVEL)
        slot = self._slots.get(packed)
        if slot is not None:
            self._counts[slot] += 1
            return slot
        if self._free:
            slot = self._free.pop()
            self._packed[slot], self._counts[slot] = packed, 1
        else:
            slot = len(self._packed)
            self._packed.append(packed)
            self._counts.append(1)
        self._slots[packed] = slot
        self._packed_bytes += sys.getsizeof(packed)
        return slot

    def release(self, slot: int) -> None:
        """Decrement the count of a slot's uses; a slot without uses is freed."""
        self._counts[slot] -= 1
        if self._counts[slot] == 0:
            packed, self._packed[slot] = self._packed[slot], b""
            del self._slots[packed]
            self._free.append(slot)
            self._packed_bytes -= sys.getsizeof(packed)

    def read(self, slots: Tensor) -> Tensor:
        """Return uint8 frames [*slots.shape, *shape] of integer slots."""
        size = self.shape.numel()
        frames = np.empty((slots.numel(), size), dtype=np.uint8)
        for row, slot in zip(frames, slots.reshape(-1).tolist(), strict=True):
            row[:] = np.frombuffer(zlib.decompress(self._packed[slot], bufsize=size), np.uint8)
        return torch.from_numpy(frames).reshape(*slots.shape, *self.shape)

    def dump(self) -> tuple[Tensor, Tensor]:
        """Return the compressed frames of all slots, concatenated, and their sizes.

        Returns:
            uint8 [bytes] and int64 [slots]; a free slot has size 0.
        """
        packed = np.frombuffer(bytearray().join(self._packed), np.uint8)
        return torch.from_numpy(packed), torch.tensor([len(p) for p in self._packed], device="cpu")

    def load(self, packed: Tensor, sizes: Tensor, uses: Iterable[int]) -> None:
        """Restore frames that ``dump`` returned.

        Args:
            packed: uint8 [bytes].
            sizes: int64 [slots].
            uses: every slot in use, once per use.
        """
        self.clear()
        ends = np.cumsum(sizes.numpy())
        data = packed.numpy()
        self._packed = [
            data[end - size : end].tobytes()
            for end, size in zip(ends.tolist(), sizes.tolist(), strict=True)
        ]
        self._counts = [0] * len(self._packed)
        for slot in uses:
            self._counts[slot] += 1
        self._slots = {packed: slot for slot, packed in enumerate(self._packed) if packed}
        self._free = [slot for slot, packed in enumerate(self._packed) if not packed]
        self._packed_bytes = sum(map(sys.getsizeof, self._slots))
