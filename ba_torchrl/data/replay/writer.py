"""A round-robin writer of the replay that never overwrites demonstrations."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictRoundRobinWriter
from torchrl.data.replay_buffers.storages import Storage

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.data.replay.storage import stored_flags


class ExpertKeepingWriter(TensorDictRoundRobinWriter):
    """TorchRL's round-robin writer, which skips demonstrations when the storage is full.

    A new transition overwrites the oldest one whose ``is_demonstration`` flag is not set. Data
    without this entry are written as by TorchRL's writer. Of equally ranked transitions, TorchRL's
    `TensorDictMaxValueWriter` keeps the oldest.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from ba_torchrl.data import ExpertKeepingWriter
        >>> storage, writer = LazyTensorStorage(8), ExpertKeepingWriter()
        >>> replay = TensorDictReplayBuffer(storage=storage, writer=writer)
        >>> steps = {"observation": torch.rand(20, 3), "is_demonstration": torch.arange(20) < 5}
        >>> steps = TensorDict(steps, [20])
        >>> first, last = replay.extend(steps[:8]), replay.extend(steps[8:])
        >>> int(replay[:]["is_demonstration"].sum())
        5
    """

    def register_storage(self, storage: Storage) -> None:
        """Set the storage to write into.

        Raises:
            ConfigError: it has several dimensions.
        """
        if storage.ndim > 1:
            raise ConfigError(
                f"{type(self).__name__} needs a storage of one dimension, got ndim={storage.ndim}; "
                "flatten transitions with reshape(-1)"
            )
        super().register_storage(storage)
        self.storage = storage

    def add(self, data: TensorDictBase) -> int:
        """Write one transition; return its index."""
        return int(self.extend(data.unsqueeze(0)))

    def extend(self, data: TensorDictBase) -> Tensor:
        """Write all demonstrations, and as many of the newest other transitions as fit.

        Args:
            data: transitions [N]; their entry "index" is set.

        Returns:
            Their indices, int64 [N]; -1 for those that do not fit, as of TorchRL's
            `TensorDictMaxValueWriter`.

        Raises:
            ConfigError: stored and new demonstrations exceed the capacity.
        """
        storage, count = self.storage, len(data)
        if len(storage) + count <= storage.max_size or keys.IS_DEMONSTRATION not in data:
            return super().extend(data)
        is_new = data[keys.IS_DEMONSTRATION].reshape(count, -1).any(1).cpu()
        is_kept = torch.zeros(storage.max_size, dtype=torch.bool, device="cpu")
        if len(storage):
            is_kept[: len(storage)] = stored_flags(storage, keys.IS_DEMONSTRATION)
        if not (is_kept.any() or is_new.any()):
            return super().extend(data)
        order = torch.arange(self._cursor, self._cursor + storage.max_size, device="cpu")
        order = order % storage.max_size
        places = order[~is_kept[order]]  # oldest first
        others = (~is_new).nonzero()[:, 0]
        excess = max(0, count - len(places))
        if not len(places) or excess > len(others):
            raise ConfigError(
                f"demonstrations fill the replay of {storage.max_size} transitions, and {count} "
                "more do not fit; raise the capacity"
            )
        is_written = torch.ones(count, dtype=torch.bool, device="cpu")
        is_written[others[:excess]] = False
        places = places[: count - excess]
        index = torch.full((count,), -1, device="cpu")
        index[is_written] = places
        self._cursor = (int(places[-1]) + 1) % storage.max_size
        data.set("index", index)
        self.write_at(places, data[is_written] if excess else data)
        return index
