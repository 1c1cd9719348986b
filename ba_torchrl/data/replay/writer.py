"""The replay's writer: round robin, except that demonstrations are never overwritten."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictRoundRobinWriter

from ba_torchrl.envs import keys
from ba_torchrl.errors import ConfigError


class ExpertKeepingWriter(TensorDictRoundRobinWriter):
    """TorchRL's round-robin writer until the storage is full; then it skips demonstrations.

    A transition whose ``is_expert`` flag is set stays for good, and others overwrite the oldest
    ones without it. Data without the flag are written as TorchRL does.
    """

    def extend(self, data: TensorDictBase) -> Tensor:
        """Write transitions [N]; return the indices, int64 [M].

        If fewer than N places can be written, the oldest of the transitions that are no
        demonstrations are left out.

        Args:
            data: one-dimensional batch; gets its ``index`` written into it.

        Raises:
            ConfigError: the demonstrations, stored and new, leave no place for the rest.
        """
        storage = self._storage
        if len(storage) + len(data) <= storage.max_size or keys.IS_EXPERT not in data:
            return super().extend(data)
        is_kept = torch.zeros(storage.max_size, dtype=torch.bool)
        if len(storage):
            is_kept[: len(storage)] = storage.column(keys.IS_EXPERT).reshape(-1)
        if not (is_kept.any() or data[keys.IS_EXPERT].any()):
            return super().extend(data)
        order = torch.arange(self._cursor, self._cursor + storage.max_size) % storage.max_size
        places = order[~is_kept[order]]
        data = self._newest(data, len(places))
        index = places[: len(data)]
        self._cursor = (int(index[-1]) + 1) % storage.max_size
        self._write_count += len(data)
        data.set("index", index)
        storage.set(index, data)
        self._mark_update_entities(index)
        return index

    def _newest(self, data: TensorDictBase, count: int) -> TensorDictBase:
        """Return at most ``count`` transitions: all demonstrations, and the newest others."""
        excess = len(data) - count
        if excess <= 0:
            return data
        others = (~data[keys.IS_EXPERT].reshape(-1)).nonzero().reshape(-1)
        if not count or excess > len(others):
            raise ConfigError(
                f"demonstrations fill the replay of {self._storage.max_size} transitions, and "
                f"{len(data)} more do not fit; raise buffer_size"
            )
        is_chosen = torch.ones(len(data), dtype=torch.bool)
        is_chosen[others[:excess]] = False
        return data[is_chosen]
