"""A TorchRL storage that stores each image once and compressed."""

from __future__ import annotations

import sys
import zlib
from collections.abc import Iterable, Mapping, Sequence
from multiprocessing.context import get_spawning_popen
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorStorage
from torchrl.data.replay_buffers.storages import Storage

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError, ReplaySchemaError, layout
from ba_torchrl.core.files import StateFolder
from ba_torchrl.data.replay.codecs import ImageCodec

_LEVEL = 1
"""Level of zlib: it compresses rendered depth fifty-fold, and higher ones gain little."""
_BYTES_PER_FRAME = 100
"""Memory of a frame's slot, count and index entry in CPython, without the compressed frame."""


class OneProcess:
    """A part of a replay whose contents other processes cannot see.

    Precedes TorchRL's class among the bases. `MultiSyncCollector` sends its replay to processes.
    """

    def __getstate__(self) -> dict[str, Any]:
        if get_spawning_popen() is not None:
            raise RuntimeError(
                f"{type(self).__name__} cannot be shared between processes: collect without "
                "replay_buffer, and extend the replay with each batch of the collector"
            )
        return super().__getstate__()


def stored_flags(storage: Storage, key: NestedKey, index: slice | Tensor = slice(None)) -> Tensor:
    """Return whether an entry is set in stored items of any of TorchRL's storages.

    Args:
        storage: of tensordicts; not empty.
        key: of the entry; of an item with several values, one suffices.
        index: of the items, int64 [N], counted over all dimensions of the storage.

    Returns:
        bool [N], on the CPU.

    Raises:
        ReplaySchemaError: the items have no such entry.
    """
    try:
        if isinstance(storage, TensorStorage):
            flags = storage.get(key).flatten(0, storage.ndim - 1)[index]
        else:
            flags = torch.stack([item[key] for item in storage.get(index)])
    except KeyError:
        raise ReplaySchemaError(
            f"the stored transitions lack {key!r}: set this flag before extend, as as_transitions "
            "does, bool [N, 1]"
        ) from None
    return flags.unsqueeze(-1).flatten(1).any(1).cpu()


class FrameTable:
    """Reference-counted uint8 frames, compressed and indexed by their content.

    Equal frames share a slot, such as the next image of a step and the image of the following step,
    in any order of insertion. Incompressible frames take their full size.

    Args:
        shape: of one frame.
    """

    def __init__(self, shape: torch.Size) -> None:
        self.shape = torch.Size(shape)
        self.image_shape: torch.Size | None = None
        """Shape of an image whose code is a frame, None before the first."""
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


class FrameStorage(OneProcess, StateFolder, LazyTensorStorage):
    """A TorchRL storage that keeps an image once, even if two transitions share it.

    All other entries are ordinary columns. Images are stored as codes of their codec, compressed
    without loss; the error of a returned image is the codec's error.

    Args:
        max_size: number of transitions.
        codecs: codec of each image by its key, such as ``depth``; also used for the same key in
            "next".
        returns_codes: return the images' codes instead of decoded images.

    Raises:
        ValueError: ``codecs`` is empty.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import TensorDictReplayBuffer
        >>> from ba_torchrl.core.images import ImageSpec
        >>> from ba_torchrl.data import FrameStorage, make_codecs
        >>> images = {"depth": ImageSpec(channels=1, size=64, high=0.4, storage="uint8")}
        >>> storage = FrameStorage(1000, make_codecs(images))
        >>> replay = TensorDictReplayBuffer(storage=storage, batch_size=16)
        >>> frames = torch.rand(9, 1, 64, 64) * 0.4
        >>> steps = {"depth": frames[:8], "next": {"depth": frames[1:]}}
        >>> index = replay.extend(TensorDict(steps, [8]))
        >>> storage.frame_count, replay.sample()["next", "depth"].shape
        (9, torch.Size([16, 1, 64, 64]))
    """

    def __init__(
        self, max_size: int, codecs: Mapping[str, ImageCodec], *, returns_codes: bool = False
    ) -> None:
        super().__init__(max_size, device="cpu")
        if not codecs:
            raise ValueError("codecs is empty: there is no image to store")
        if others := [key for key, codec in codecs.items() if not hasattr(codec, "encode")]:
            raise ConfigError(f"codecs: {', '.join(others)} has no codec: pass make_codecs(images)")
        self.codecs = dict(codecs)
        self.returns_codes = returns_codes
        self.frame_keys: list[NestedKey] = [
            nested for key in codecs for nested in (key, (keys.NEXT, key))
        ]
        self._frames: dict[str, FrameTable] = {}
        # Slots of (image, next image) by key and transition, -1 where none is stored yet.
        self._slots = torch.full(
            (len(codecs), self.max_size, 2), -1, dtype=torch.int32, device="cpu"
        )

    def set(
        self,
        cursor: int | Sequence[int] | slice | Tensor,
        data: TensorDictBase | list[TensorDictBase],
        *,
        set_cursor: bool = True,
    ) -> None:
        """Store transitions.

        Args:
            cursor: indices of the transitions, or a mask.
            data: one transition if ``cursor`` is a number, else a batch or list of them.
            set_cursor: whether the storage's length is extended to these indices, as for a writer.

        Raises:
            ReplaySchemaError: an image is missing, or of another shape than those stored.
        """
        if isinstance(cursor, slice):
            cursor = range(self.max_size)[cursor]
        indices = torch.as_tensor(cursor, device="cpu")
        if not indices.ndim:
            indices, data = indices.unsqueeze(0), data.unsqueeze(0)
        elif isinstance(data, list):
            data = torch.stack(data)
        indices = indices.nonzero()[:, 0] if indices.dtype == torch.bool else indices.long()
        if len(indices) > self.max_size:  # keep the last of each index
            indices, data = indices[-self.max_size :], data[-self.max_size :]
        tables = self.tables(data)
        super().set(indices, data.exclude(*self.frame_keys), set_cursor=set_cursor)
        self._frames |= tables
        for number, (key, codec) in enumerate(self.codecs.items()):
            images = [data.get(nested).cpu() for nested in (key, (keys.NEXT, key))]
            self._store_frames(indices, images, codec, tables[key], self._slots[number])

    def tables(self, data: TensorDictBase) -> dict[str, FrameTable]:
        """Return the tables that take the images of transitions [N], by key; new ones at first.

        Raises:
            ReplaySchemaError: an image is missing, or of another shape than those stored.
        """
        return {key: self._table(key, data) for key in self.codecs}

    def _table(self, key: str, data: TensorDictBase) -> FrameTable:
        table = self._frames.get(key)
        for nested in (key, (keys.NEXT, key)):
            image = data.get(nested, None)
            if image is None:
                raise ReplaySchemaError(f"transitions lack {nested!r}")
            if table is not None and image.shape[1:] == table.image_shape:
                continue
            shape = self.codecs[key].encode(image[:0]).shape[1:]
            table = FrameTable(shape) if table is None else table
            if shape != table.shape:
                raise ReplaySchemaError(
                    f"{nested!r} is {layout(image.dtype, image.shape[1:])}, and images of another "
                    "shape are stored or precede it"
                )
            table.image_shape = image.shape[1:]
        return table

    @staticmethod
    def _store_frames(
        indices: Tensor, images: list[Tensor], codec: ImageCodec, frames: FrameTable, slots: Tensor
    ) -> None:
        slots = slots.numpy()
        for row, place in enumerate(indices.tolist()):
            # One image at a time: torch starts no threads for a single image. Threads cost
            # milliseconds while the environments use all cores.
            codes = [codec.encode(image[row]).flatten().numpy() for image in images]
            # New frames are acquired before the old ones are released, so that a frame in both is
            # not freed.
            new = [frames.acquire(code) for code in codes]
            for slot in slots[place].tolist():
                if slot >= 0:
                    frames.release(slot)
            slots[place] = new

    def get(
        self, index: int | Sequence[int] | slice | Tensor | NestedKey
    ) -> TensorDictBase | Tensor:
        """Return transitions with decoded images, or their codes.

        A slice over the whole storage decodes every image; `column` decodes none. TorchRL's
        `SliceSampler` takes such a slice for each batch, its sample unit `Sequence` one entry; of
        demonstrations, `BulletArmExperienceReplay` has decoded images.

        Args:
            index: of the transitions; or the key of an entry, of all transitions.
        """
        if isinstance(index, str) or (isinstance(index, tuple) and isinstance(index[0], str)):
            key = unravel_key(index)
            has_images = key == keys.NEXT or key in self.frame_keys
            return self.get(slice(None))[key] if has_images else self.column(key)
        data = super().get(index).copy()
        for number, (key, codec) in enumerate(self.codecs.items()):
            slots = self._slots[number, : len(self)][index]
            images = self._frames[key].read(slots)
            if not self.returns_codes:
                images = codec.decode(images)
            for i, nested in enumerate((key, (keys.NEXT, key))):
                data.set(nested, images.select(slots.ndim - 1, i))
        return data

    def column(self, key: NestedKey) -> Tensor:
        """Return a view of one entry of all stored transitions; images have no column.

        Raises:
            KeyError: the entry is not stored.
        """
        if not self.initialized:
            raise KeyError(f"{key!r}: the replay is empty")
        return self.columns[key]

    @property
    def columns(self) -> TensorDictBase:
        """Views of the stored entries, images left out; at least one transition must be stored."""
        return super().get(slice(None))

    @property
    def image_types(self) -> dict[str, tuple[torch.dtype, torch.Size]]:
        """Type and shape of each image by key; empty before the first transition is stored."""
        decoded = {
            key: self.codecs[key].decode(torch.zeros(table.shape, dtype=torch.uint8, device="cpu"))
            for key, table in self._frames.items()
        }
        return {key: (image.dtype, image.shape) for key, image in decoded.items()}

    @property
    def frame_count(self) -> int:
        """Number of distinct frames of all keys."""
        return sum(len(frames) for frames in self._frames.values())

    @property
    def nbytes(self) -> int:
        """Bytes of memory in use, without reserved pages that were never written."""
        if not self._frames:
            return 0
        columns = sum(value.nbytes for value in self.columns.values(True, True))
        slots = len(self) * self._slots.element_size() * 2 * len(self.codecs)
        return columns + slots + sum(frames.nbytes for frames in self._frames.values())

    def _empty(self) -> None:
        super()._empty()
        self._slots.fill_(-1)
        for frames in self._frames.values():
            frames.clear()

    def state_dict(self) -> dict[str, Any]:
        """Return columns, frames and slots of the frames. They are views: do not modify them."""
        if not self.initialized:
            return {"size": 0}
        size = len(self)
        frames = {}
        for number, (key, table) in enumerate(self._frames.items()):
            packed, sizes = table.dump()
            frames[key] = {
                "slots": self._slots[number, :size],
                "shape": list(table.shape),
                "sizes": sizes,
                "packed": packed,
            }
        return {
            "size": size,
            "columns": {
                "/".join(key) if isinstance(key, tuple) else key: value
                for key, value in self.columns.items(True, True)
            },
            "frames": frames,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the columns and frames of a ``state_dict``.

        Args:
            state_dict: of a storage that holds at most this storage's capacity.

        Raises:
            ValueError: it holds too many transitions, or images with other keys.
        """
        size = state_dict["size"]
        if size > self.max_size:
            raise ValueError(f"{size} saved transitions do not fit into {self.max_size}")
        if not size:
            self._empty()
            return
        if set(state_dict["frames"]) != set(self.codecs):
            raise ValueError(
                f"images saved: {', '.join(state_dict['frames'])}; kept here: "
                f"{', '.join(self.codecs)}"
            )
        # copies, as a storage's own state is a view of it
        saved = state_dict["columns"].items()
        columns = TensorDict(
            {tuple(name.split("/")): value.clone() for name, value in saved}, batch_size=[size]
        )
        slots = torch.stack([state_dict["frames"][key]["slots"] for key in self.codecs])
        self._empty()
        super().set(torch.arange(size, device="cpu"), columns)
        self._slots[:, :size] = slots
        for key, used in zip(self.codecs, slots, strict=True):
            saved = state_dict["frames"][key]
            self._frames[key] = FrameTable(torch.Size(saved["shape"]))
            self._frames[key].load(saved["packed"], saved["sizes"], used.reshape(-1).tolist())
