"""A TorchRL replay buffer that stores each image once and compressed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import RandomSampler, Sampler

from ba_torchrl.data.replay.codecs import ImageCodec
from ba_torchrl.data.replay.frames import FrameTable
from ba_torchrl.data.replay.prioritized import ExpertPrioritizedSampler
from ba_torchrl.data.replay.schema import Schema, differences
from ba_torchrl.data.replay.writer import ExpertKeepingWriter
from ba_torchrl.data.state_files import read_state, write_state
from ba_torchrl.envs import keys
from ba_torchrl.errors import ReplaySchemaError

_INDEX = "index"  # TorchRL's writer adds it
_NOT_STORED = (keys.FAULT, (keys.NEXT, keys.FAULT))


class FrameStorage(LazyTensorStorage):
    """A TorchRL storage that stores an image once, also where it is both an image and a next image.

    All other entries are ordinary columns. Images are stored as codes of their codec, compressed
    without loss; the error of a returned image is the codec's error.

    Args:
        max_size: number of transitions.
        codecs: codec of each image by its key, such as ``pixels``; also used for the same key in
            "next".
        returns_codes: return the images' codes instead of decoded images.

    Raises:
        ValueError: ``codecs`` is empty.
    """

    def __init__(
        self, max_size: int, codecs: Mapping[str, ImageCodec], *, returns_codes: bool = False
    ) -> None:
        super().__init__(max_size, device="cpu")
        if not codecs:
            raise ValueError("codecs is empty: there is no image to store")
        self.codecs = dict(codecs)
        self.returns_codes = returns_codes
        self.frame_keys: list[NestedKey] = [
            nested for key in codecs for nested in (key, (keys.NEXT, key))
        ]
        self._frames: dict[str, FrameTable] = {}
        # Slots of (image, next image) by key and transition, -1 where none is stored yet.
        self._slots = torch.full((len(codecs), self.max_size, 2), -1, dtype=torch.int32)

    def set(
        self,
        cursor: int | Sequence[int] | slice | Tensor,
        data: TensorDictBase,
        *,
        set_cursor: bool = True,
    ) -> None:
        """Store transitions.

        Args:
            cursor: indices of the transitions.
            data: one transition if ``cursor`` is an int, else a batch of them.
            set_cursor: whether the storage's length is extended to these indices, as for a writer.
        """
        if isinstance(cursor, int) or (isinstance(cursor, Tensor) and not cursor.ndim):
            cursor, data = [int(cursor)], data.unsqueeze(0)
        indices = torch.arange(self.max_size)[cursor] if isinstance(cursor, slice) else cursor
        indices = torch.as_tensor(indices, dtype=torch.long)
        if len(indices) > self.max_size:  # keep the last of each index
            indices, data = indices[-self.max_size :], data[-self.max_size :]
        super().set(indices, data.exclude(*self.frame_keys), set_cursor=set_cursor)
        for number, (key, codec) in enumerate(self.codecs.items()):
            images = [data.get(nested).cpu() for nested in (key, (keys.NEXT, key))]
            if key not in self._frames:
                self._frames[key] = FrameTable(codec.encode(images[0][:1]).shape[1:])
            self._store_frames(indices, images, codec, self._frames[key], self._slots[number])

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

    def get(self, index: int | Sequence[int] | slice | Tensor) -> TensorDictBase:
        """Return transitions with decoded images, or their codes.

        A slice over the whole storage decodes every image; `column` decodes none.

        Args:
            index: of the transitions.
        """
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

        Args:
            key: of the entry.

        Raises:
            KeyError: the entry is not stored.
        """
        if not self.initialized:
            raise KeyError(f"{key!r}: the replay is empty")
        return self._storage[key][: len(self)]

    @property
    def image_types(self) -> dict[str, tuple[torch.dtype, torch.Size]]:
        """Type and shape of each image by key; empty before the first transition is stored."""
        decoded = {
            key: self.codecs[key].decode(torch.zeros(table.shape, dtype=torch.uint8))
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
        row = sum(
            value[0].numel() * value.element_size() for value in self._storage.values(True, True)
        )
        row += self._slots.element_size() * 2 * len(self.codecs)
        return len(self) * row + sum(frames.nbytes for frames in self._frames.values())

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
        columns = self._storage[:size]
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
                for key, value in columns.items(True, True)
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
        self._empty()
        if not size:
            return
        if set(state_dict["frames"]) != set(self.codecs):
            raise ValueError(
                f"images saved: {', '.join(state_dict['frames'])}; kept here: "
                f"{', '.join(self.codecs)}"
            )
        columns = TensorDict(
            {tuple(name.split("/")): value for name, value in state_dict["columns"].items()},
            batch_size=[size],
        )
        super().set(torch.arange(size), columns)
        self._frames = {}
        for number, key in enumerate(self.codecs):
            saved = state_dict["frames"][key]
            self._slots[number, :size] = saved["slots"]
            self._frames[key] = FrameTable(torch.Size(saved["shape"]))
            self._frames[key].load(
                saved["packed"], saved["sizes"], saved["slots"].reshape(-1).tolist()
            )

    def dumps(self, path: str | Path) -> None:
        """Write the contents into a folder, as plain data."""
        write_state(path, self.state_dict())

    def loads(self, path: str | Path) -> None:
        """Read a folder that ``dumps`` wrote.

        Raises:
            ConfigError: it holds files that are not plain data.
        """
        self.load_state_dict(read_state(path))


class FrameReplayBuffer(TensorDictReplayBuffer):
    """A replay buffer on a `FrameStorage` that checks transitions and keeps demonstrations.

    Entries, types and shapes of the first transitions are required of all later ones, because
    TorchRL would keep stale values of a missing entry. Transitions whose ``fault`` flag is set are
    dropped and counted in ``faults_dropped``; the flag is not stored. When the buffer is full, new
    transitions overwrite the oldest ones that are not demonstrations. The input is not modified.

    Args:
        storage: the frame storage.
        sampler: a TorchRL sampler.
        batch_size: of a sample; None if each call of ``sample`` passes it.
        generator: source of uniform draws.
    """

    def __init__(
        self,
        *,
        storage: FrameStorage,
        sampler: Sampler,
        batch_size: int | None,
        generator: torch.Generator,
    ) -> None:
        super().__init__(
            storage=storage,
            sampler=sampler,
            writer=ExpertKeepingWriter(),
            batch_size=batch_size,
            generator=generator,
            priority_key=keys.TD_ERROR,
        )
        self.faults_dropped = 0

    def add(self, data: TensorDictBase) -> Tensor:
        """Store one transition.

        Args:
            data: a transition without batch shape.

        Returns:
            Its index [1], or an empty tensor [0] for a fault.

        Raises:
            ReplaySchemaError: entries, types or shapes are not those of the stored ones.
        """
        return self.extend(data.unsqueeze(0))

    def extend(self, tensordicts: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Store transitions and drop those with a fault.

        Args:
            tensordicts: transitions [N].
            update_priority: see TorchRL.

        Returns:
            Indices of the stored transitions, int64 [M], M <= N.

        Raises:
            ReplaySchemaError: entries, types or shapes are not those of the stored ones.
            ConfigError: demonstrations leave no room for these transitions.
        """
        if tensordicts.ndim != 1:
            raise ReplaySchemaError(
                f"transitions must have one batch dimension, got {tuple(tensordicts.shape)}; "
                "flatten with reshape(-1)"
            )
        fault = tensordicts.get((keys.NEXT, keys.FAULT), None)
        data = tensordicts.exclude(*_NOT_STORED, _INDEX)
        self._check_schema(data)
        if fault is not None and fault.any():
            sound = ~fault.reshape(-1)
            self.faults_dropped += int((~sound).sum())
            data = data[sound]
        if not len(data):
            return torch.zeros(0, dtype=torch.long)
        data = self.writer.select_fitting(data)
        return super().extend(data, update_priority=update_priority)

    def dumps(self, path: str | Path) -> None:
        """Write transitions, priorities and the state of the draws into a folder, as plain data."""
        write_state(path, self.state_dict())

    def loads(self, path: str | Path) -> None:
        """Read a folder that ``dumps`` wrote.

        Raises:
            ConfigError: it holds files that are not plain data.
        """
        self.load_state_dict(read_state(path))

    def _check_schema(self, data: TensorDictBase) -> None:
        found = {key: (value.dtype, value.shape[1:]) for key, value in data.items(True, True)}
        expected = self._schema()
        if expected is None:
            missing = [key for key in self.storage.frame_keys if key not in found]
            if missing:
                raise ReplaySchemaError(f"transitions lack {missing}")
            return
        problems = differences(found, expected)
        if problems:
            raise ReplaySchemaError(
                "transitions differ from those in the replay: " + "; ".join(problems)
            )

    def _schema(self) -> Schema | None:
        """Return type and shape of every stored entry, None if the buffer is empty."""
        storage: FrameStorage = self.storage
        if not storage.initialized:
            return None
        schema = {
            key: (value.dtype, value.shape[1:])
            for key, value in storage._storage.items(True, True)
            if key != _INDEX
        }
        for key, image_type in storage.image_types.items():
            schema |= dict.fromkeys((key, (keys.NEXT, key)), image_type)
        return schema


def make_replay_buffer(
    capacity: int,
    batch_size: int | None,
    *,
    codecs: Mapping[str, ImageCodec],
    seed: int,
    prioritized: bool = True,
    priority_exponent: float = 0.6,
    weight_exponent: float = 0.4,
    expert_bonus: float = 1.0,
    returns_codes: bool = False,
) -> FrameReplayBuffer:
    """Return an empty replay buffer with uniform or prioritised sampling (appendix G.2).

    Args:
        capacity: number of transitions.
        batch_size: of a sample; None if each call of ``sample`` passes it.
        codecs: codec of each image by key; the acting policy must use the same.
        seed: of the draws.
        prioritized: sample by TD error with a bonus for demonstrations, else uniformly.
        priority_exponent: alpha.
        weight_exponent: beta at the start of the run; ``buffer.sampler.anneal`` raises it.
        expert_bonus: added to the priority of demonstrations.
        returns_codes: samples hold the images' codes instead of decoded images.
    """
    generator = torch.Generator().manual_seed(seed)
    sampler: Sampler = RandomSampler()
    if prioritized:
        sampler = ExpertPrioritizedSampler(
            capacity,
            generator=generator,
            alpha=priority_exponent,
            beta=weight_exponent,
            expert_bonus=expert_bonus,
        )
    return FrameReplayBuffer(
        storage=FrameStorage(capacity, codecs, returns_codes=returns_codes),
        sampler=sampler,
        batch_size=batch_size,
        generator=generator,
    )
