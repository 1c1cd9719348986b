"""A table of compressed images that keeps equal ones once."""

from __future__ import annotations

import sys
import zlib
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

_LEVEL = 1
"""Of zlib. Rendered depth shrinks fifty-fold; higher levels take longer for little more."""
_BYTES_PER_FRAME = 100
"""Of slot, count and index entry in CPython, beside the frame itself."""


class FrameTable:
    """Reference-counted uint8 frames, compressed, found again by their content.

    A frame is shared whenever an equal one is held: a step's next image with the following step's
    image, whatever the order in which environments, demonstrations and resets are interleaved.
    Nothing is assumed about neighbouring transitions, nor about the images: those that do not
    compress take as much as they would uncompressed.

    Args:
        shape: of one frame.
    """

    def __init__(self, shape: torch.Size) -> None:
        self.shape = torch.Size(shape)
        self.clear()

    def clear(self) -> None:
        """Forget every frame."""
        self._packed: list[bytes] = []  # by slot; empty where free
        self._counts: list[int] = []
        self._free: list[int] = []
        self._slots: dict[bytes, int] = {}
        self._packed_bytes = 0

    def __len__(self) -> int:
        """Number of frames held."""
        return len(self._slots)

    @property
    def nbytes(self) -> int:
        """Bytes of memory in use, that of Python's objects included."""
        return self._packed_bytes + _BYTES_PER_FRAME * len(self._packed)

    def acquire(self, frame: np.ndarray) -> int:
        """Return the slot of a frame, stored now if none equal is held, counted once more.

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
        """Count a use of a slot less, and free it after the last one."""
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
        """Return the compressed frames of all slots, one after the other, and their sizes.

        Returns:
            uint8 [bytes] and int64 [slots]; a free slot has size 0.
        """
        packed = np.frombuffer(bytearray().join(self._packed), np.uint8)
        return torch.from_numpy(packed), torch.tensor([len(p) for p in self._packed])

    def load(self, packed: Tensor, sizes: Tensor, uses: Iterable[int]) -> None:
        """Take over frames that ``dump`` returned.

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
