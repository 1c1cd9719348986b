"""A TorchRL replay buffer of transitions with compressed images."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import Sampler

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError, ReplaySchemaError, layout
from ba_torchrl.core.files import StateFolder
from ba_torchrl.data.replay.storage import FrameStorage, stored_flags
from ba_torchrl.data.replay.writer import ExpertKeepingWriter

_INDEX = "index"  # TorchRL's writer adds it
_NOT_STORED = (keys.FAULT, (keys.NEXT, keys.FAULT))

Schema = dict[NestedKey, tuple[torch.dtype, torch.Size]]
"""Type and shape of each entry by key, without the batch dimension."""


class FrameReplayBuffer(StateFolder, TensorDictReplayBuffer):
    """A replay buffer on a `FrameStorage` that checks transitions and keeps demonstrations.

    Entries, types and shapes of the first transitions are required of all later ones, because
    TorchRL would keep stale values of a missing entry. Transitions whose ``fault`` flag is set are
    dropped; the flag is not stored. When the buffer is full, new transitions overwrite the oldest
    ones that are not demonstrations. The input is not modified. ``dumps`` writes transitions,
    priorities and the state of the draws.

    Args:
        storage: the frame storage.
        sampler: a TorchRL sampler.
        batch_size: of a sample; None if each call of ``sample`` passes it.
        generator: source of the draws of samplers without their own.

    Raises:
        ConfigError: the storage is not a `FrameStorage`.

    Examples:
        >>> import torch
        >>> from torchrl.data.replay_buffers.samplers import RandomSampler
        >>> from ba_torchrl.core.images import ImageSpec
        >>> from ba_torchrl.data import FrameReplayBuffer, FrameStorage, make_codecs
        >>> images = {"depth": ImageSpec(channels=1, size=64, high=0.4, storage="uint8")}
        >>> replay = FrameReplayBuffer(
        ...     storage=FrameStorage(1000, make_codecs(images)), sampler=RandomSampler(),
        ...     batch_size=32, generator=torch.Generator().manual_seed(0),
        ... )
        >>> len(replay)
        0
    """

    def __init__(
        self,
        *,
        storage: FrameStorage,
        sampler: Sampler,
        batch_size: int | None,
        generator: torch.Generator,
    ) -> None:
        if not isinstance(storage, FrameStorage):
            raise ConfigError(
                f"{type(self).__name__} needs a FrameStorage; for a {type(storage).__name__}, pass "
                "the sampler and an ExpertKeepingWriter to TorchRL's TensorDictReplayBuffer"
            )
        super().__init__(
            storage=storage,
            sampler=sampler,
            writer=ExpertKeepingWriter(),
            batch_size=batch_size,
            generator=generator,
            priority_key=keys.TD_ERROR,
        )

    def add(self, data: TensorDictBase) -> Tensor:
        """Store one transition.

        Returns:
            Its index [1], or an empty tensor [0] for a fault.
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
        if not isinstance(tensordicts, TensorDictBase):
            kind = type(tensordicts).__name__
            raise ReplaySchemaError(f"transitions must be a TensorDict [N], not a {kind}")
        if tensordicts.ndim != 1:
            raise ReplaySchemaError(
                f"transitions must have one batch dimension, got {tuple(tensordicts.shape)}; "
                "flatten with reshape(-1)"
            )
        fault = tensordicts.get((keys.NEXT, keys.FAULT), None)
        data = tensordicts.exclude(*_NOT_STORED, _INDEX)
        self._check_schema(data)
        if fault is not None and fault.any():
            data = data[~fault.reshape(-1)]
        if not len(data):
            return torch.zeros(0, dtype=torch.long, device="cpu")
        index = super().extend(data, update_priority=update_priority)
        return index[index >= 0]

    @property
    def num_demonstrations(self) -> int:
        """Number of stored transitions with the flag ``is_demonstration``."""
        return int(stored_flags(self.storage, keys.IS_DEMONSTRATION).sum()) if len(self) else 0

    def _check_schema(self, data: TensorDictBase) -> None:
        found = {key: (value.dtype, value.shape[1:]) for key, value in data.items(True, True)}
        expected = self._schema()
        if expected is None:
            self.storage.tables(data)  # raises for images that do not fit
            return
        problems = _differences(found, expected)
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
            for key, value in storage.columns.items(True, True)
            if key != _INDEX
        }
        for key, image_type in storage.image_types.items():
            schema |= dict.fromkeys((key, (keys.NEXT, key)), image_type)
        return schema


def _differences(found: Schema, expected: Schema) -> list[str]:
    """Return a description of each entry that differs, sorted."""
    problems = [f"missing {key!r}" for key in expected if key not in found]
    problems += [f"unexpected {key!r}" for key in found if key not in expected]
    problems += [
        f"{key!r} is {layout(*found[key])}, stored as {layout(*expected[key])}"
        for key in expected
        if key in found and found[key] != expected[key]
    ]
    return sorted(problems)
