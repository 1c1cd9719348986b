"""The replay: each image once, compressed, behind TorchRL's own replay buffer."""

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
from ba_torchrl.data.replay.writer import ExpertKeepingWriter
from ba_torchrl.envs import keys
from ba_torchrl.errors import ReplaySchemaError

_INDEX = "index"  # TorchRL's writer adds it
_NOT_STORED = (keys.FAULT, (keys.NEXT, keys.FAULT))


class FrameStorage(LazyTensorStorage):
    """A TorchRL storage that keeps each image once, as a step's observation and as its next one.

    All other entries are ordinary columns. Images are stored as their codec's codes, compressed
    without loss, and come out within the codec's error.

    Args:
        max_size: number of transitions.
        codecs: codec of each image by its key, such as ``pixels``; also of the image of the same
            key in "next".

    Raises:
        ValueError: there is no image.
    """

    def __init__(self, max_size: int, codecs: Mapping[str, ImageCodec]) -> None:
        super().__init__(max_size, device="cpu")
        if not codecs:
            raise ValueError("codecs is empty: there is no image to store")
        self.codecs = dict(codecs)
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
            cursor: their indices.
            data: one transition for an int, else a batch of them.
            set_cursor: whether the storage's length grows with them, as for a writer.
        """
        if isinstance(cursor, int) or (isinstance(cursor, Tensor) and not cursor.ndim):
            cursor, data = [int(cursor)], data.unsqueeze(0)
        places = torch.arange(self.max_size)[cursor] if isinstance(cursor, slice) else cursor
        places = torch.as_tensor(places, dtype=torch.long)
        if len(places) > self.max_size:  # each index once, with the last
            places, data = places[-self.max_size :], data[-self.max_size :]
        super().set(places, data.exclude(*self.frame_keys), set_cursor=set_cursor)
        for number, (key, codec) in enumerate(self.codecs.items()):
            images = [data.get(nested).cpu() for nested in (key, (keys.NEXT, key))]
            if key not in self._frames:
                self._frames[key] = FrameTable(codec.encode(images[0][:1]).shape[1:])
            self._store_frames(places, images, codec, self._frames[key], self._slots[number])

    @staticmethod
    def _store_frames(
        places: Tensor, images: list[Tensor], codec: ImageCodec, frames: FrameTable, slots: Tensor
    ) -> None:
        slots = slots.numpy()
        for row, place in enumerate(places.tolist()):
            # One by one: a single image is too small for torch to start its threads, which costs
            # milliseconds while environments keep the cores busy.
            codes = [codec.encode(image[row]).flatten().numpy() for image in images]
            # Acquired before the old ones are released, so that a frame in both stays.
            new = [frames.acquire(code) for code in codes]
            for slot in slots[place].tolist():
                if slot >= 0:
                    frames.release(slot)
            slots[place] = new

    def get(self, index: int | Sequence[int] | slice | Tensor) -> TensorDictBase:
        """Return transitions, images decoded.

        A slice over the whole storage decodes every image; ``column`` decodes none.

        Args:
            index: which.
        """
        data = super().get(index).copy()
        for number, (key, codec) in enumerate(self.codecs.items()):
            slots = self._slots[number, : len(self)][index]
            images = codec.decode(self._frames[key].read(slots))
            for i, nested in enumerate((key, (keys.NEXT, key))):
                data.set(nested, images.select(slots.ndim - 1, i))
        return data

    def column(self, key: NestedKey) -> Tensor:
        """Return one entry, not an image, of all transitions stored: a view.

        Args:
            key: the entry.

        Raises:
            KeyError: it is not stored.
        """
        if not self.initialized:
            raise KeyError(f"{key!r}: the replay is empty")
        return self._storage[key][: len(self)]

    @property
    def image_types(self) -> dict[str, tuple[torch.dtype, torch.Size]]:
        """Type and shape of each image by key, once one is stored."""
        decoded = {
            key: self.codecs[key].decode(torch.zeros(table.shape, dtype=torch.uint8))
            for key, table in self._frames.items()
        }
        return {key: (image.dtype, image.shape) for key, image in decoded.items()}

    @property
    def frame_count(self) -> int:
        """Number of different frames held, of all keys together."""
        return sum(len(frames) for frames in self._frames.values())

    @property
    def nbytes(self) -> int:
        """Bytes of memory in use; reserved pages that were never written are not counted."""
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
        """Return columns, frames and their assignment; they are views and must not be changed."""
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
            state_dict: of a storage with at most this one's capacity.

        Raises:
            ValueError: it holds more transitions than fit, or other images.
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
        """Write the contents into a folder, made if missing."""
        Path(path).mkdir(parents=True, exist_ok=True)
        torch.save(self.state_dict(), Path(path) / "frames.pt")

    def loads(self, path: str | Path) -> None:
        """Read the contents from a folder that ``dumps`` wrote."""
        # Mapped, so that the frames do not pass through memory twice.
        self.load_state_dict(torch.load(Path(path) / "frames.pt", weights_only=True, mmap=True))


class FrameReplayBuffer(TensorDictReplayBuffer):
    """TorchRL's buffer on a `FrameStorage`, which checks transitions and keeps demonstrations.

    The first transitions fix the entries, types and shapes; later ones must have the same, since
    TorchRL would keep stale values where one is missing. Transitions whose ``fault`` flag is set
    are left out and counted in ``faults_dropped``; the flag itself is not stored. Once the buffer
    is full, new transitions overwrite the oldest ones that are no demonstrations. The input is not
    changed.

    Args:
        storage: the frame storage.
        sampler: TorchRL's or ours.
        batch_size: of a sample; None where every call gives it.
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
        """Store transitions, faults left out.

        Args:
            tensordicts: transitions [N].
            update_priority: see TorchRL.

        Returns:
            Indices of those that were stored, int64 [M], M <= N.

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
        data = self.writer.fitting(data)
        return super().extend(data, update_priority=update_priority)

    def _check_schema(self, data: TensorDictBase) -> None:
        found = {key: (value.dtype, value.shape[1:]) for key, value in data.items(True, True)}
        expected = self._schema()
        if expected is None:
            missing = [key for key in self.storage.frame_keys if key not in found]
            if missing:
                raise ReplaySchemaError(f"transitions lack {missing}")
            return
        problems = [f"missing {key!r}" for key in expected if key not in found]
        problems += [f"unexpected {key!r}" for key in found if key not in expected]
        problems += [
            f"{key!r} is {_text(*found[key])}, stored as {_text(*expected[key])}"
            for key in expected
            if key in found and found[key] != expected[key]
        ]
        if problems:
            raise ReplaySchemaError(
                "transitions differ from those in the replay: " + "; ".join(sorted(problems))
            )

    def _schema(self) -> dict[NestedKey, tuple[torch.dtype, torch.Size]] | None:
        """Return type and shape of every entry stored, None while there is none."""
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


def _text(dtype: torch.dtype, shape: torch.Size) -> str:
    return f"{str(dtype).removeprefix('torch.')}{list(shape)}"


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
) -> FrameReplayBuffer:
    """Return an empty replay from which transitions are drawn uniformly or by priority (G.2).

    Args:
        capacity: number of transitions.
        batch_size: of a sample; None where every call gives it.
        codecs: codec of each image by key; the acting policy must use the same.
        seed: of the draws.
        prioritized: draw by TD error with the bonus of demonstrations, else uniformly.
        priority_exponent: alpha.
        weight_exponent: beta at the start of the run; ``buffer.sampler.anneal`` raises it.
        expert_bonus: added to the priority of demonstrations.
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
        storage=FrameStorage(capacity, codecs),
        sampler=sampler,
        batch_size=batch_size,
        generator=generator,
    )
