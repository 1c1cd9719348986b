"""A table of images that keeps equal ones once."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


class FrameTable:
    """Reference-counted uint8 frames, found again by their content.

    A frame is shared whenever an equal one is held: a step's next image with the following step's
    image, whatever the order in which environments, demonstrations and resets are interleaved.
    Nothing is assumed about neighbouring transitions. The memory is reserved at once, but pages
    that were never written cost nothing, and freed frames are used again first.

    Args:
        capacity: largest number of frames.
        shape: of one frame.
    """

    def __init__(self, capacity: int, shape: torch.Size) -> None:
        self.shape = torch.Size(shape)
        # Not torch.zeros, which would touch every page.
        self._data = torch.empty((capacity, self.shape.numel()), dtype=torch.uint8)
        self._rows = self._data.numpy()
        self._counts = np.zeros(capacity, dtype=np.int32)
        self._free: list[int] = []
        self._touched = 0
        self._by_content: dict[int, int] = {}
        self._hashes = np.zeros(capacity, dtype=np.int64)

    def __len__(self) -> int:
        """Number of frames held."""
        return self._touched - len(self._free)

    @property
    def nbytes(self) -> int:
        """Bytes of the pages in use: frames held and freed, and the tables beside them."""
        per_frame = self._data.shape[1] + self._counts.itemsize + self._hashes.itemsize
        index = 100 * len(self._by_content)  # CPython: two boxed integers and a table entry
        return self._touched * per_frame + index

    def acquire(self, frame: np.ndarray) -> int:
        """Return the slot of a frame, stored now if none equal is held, counted once more.

        Args:
            frame: uint8 of one frame's size, flat and contiguous.

        Raises:
            MemoryError: the table is full.
        """
        key = hash(frame.tobytes())
        slot = self._by_content.get(key)
        if slot is not None and np.array_equal(self._rows[slot], frame):
            self._counts[slot] += 1
            return slot
        if self._free:
            new = self._free.pop()
        elif self._touched < len(self._counts):
            new = self._touched
            self._touched += 1
        else:
            raise MemoryError(f"the frame table is full ({len(self._counts)} frames)")
        self._rows[new] = frame
        self._counts[new] = 1
        self._hashes[new] = key
        # Should two frames ever collide, the later one is found from now on; both stay valid.
        self._by_content[key] = new
        return new

    def release(self, slot: int) -> None:
        """Count a use of a slot less, and free it after the last one."""
        self._counts[slot] -= 1
        if self._counts[slot] == 0:
            key = int(self._hashes[slot])
            if self._by_content.get(key) == slot:
                del self._by_content[key]
            self._free.append(slot)

    def read(self, slots: Tensor) -> Tensor:
        """Return uint8 frames [*slots.shape, *shape] of int64 slots."""
        rows = self._data.index_select(0, slots.reshape(-1))
        return rows.reshape(*slots.shape, *self.shape)

    def clear(self) -> None:
        """Forget every frame; touched pages stay for reuse."""
        self._counts[:] = 0
        self._free, self._touched, self._by_content = [], 0, {}

    def touched(self) -> Tensor:
        """Return the frames held and freed [n, *shape], a view."""
        return self._data[: self._touched].unflatten(1, self.shape)

    def restore(self, frames: Tensor, slots: Tensor) -> None:
        """Take over saved frames.

        Args:
            frames: what ``touched`` returned, uint8 [n, *shape].
            slots: every slot in use, once per use.
        """
        self.clear()
        self._touched = len(frames)
        self._data[: self._touched] = frames.flatten(1)
        counts = np.bincount(slots.numpy().reshape(-1), minlength=self._touched)
        self._counts[: self._touched] = counts
        for slot in range(self._touched):
            if counts[slot]:
                key = hash(self._rows[slot].tobytes())
                self._by_content[key] = slot
                self._hashes[slot] = key
            else:
                self._free.append(slot)
