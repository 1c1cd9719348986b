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

    A transition whose ``is_expert`` flag is set is never overwritten; others overwrite the oldest
    ones without it. Data without the flag are written as TorchRL does.
    """

    def fitting(self, data: TensorDictBase) -> TensorDictBase:
        """Return the transitions that there is room for: all demonstrations, the newest others.

        Args:
            data: transitions [N].

        Raises:
            ConfigError: the demonstrations, stored and new, leave no room.
        """
        places = self._places(data)
        excess = 0 if places is None else len(data) - len(places)
        if excess <= 0:
            return data
        others = (~data[keys.IS_EXPERT].reshape(-1)).nonzero().reshape(-1)
        if not len(places) or excess > len(others):
            raise ConfigError(
                f"demonstrations fill the replay of {self._storage.max_size} transitions, and "
                f"{len(data)} more do not fit; raise buffer_size"
            )
        is_chosen = torch.ones(len(data), dtype=torch.bool)
        is_chosen[others[:excess]] = False
        return data[is_chosen]

    def extend(self, data: TensorDictBase) -> Tensor:
        """Write transitions [N] that `fitting` returned; return their indices, int64 [N]."""
        places = self._places(data)
        if places is None:
            return super().extend(data)
        index = places[: len(data)]
        self._cursor = (int(index[-1]) + 1) % self._storage.max_size
        self._write_count += len(data)
        data.set("index", index)
        self._storage.set(index, data)
        self._mark_update_entities(index)
        return index

    def _places(self, data: TensorDictBase) -> Tensor | None:
        """Return the indices that can be written, the oldest first; None for all, in turn."""
        storage = self._storage
        if len(storage) + len(data) <= storage.max_size or keys.IS_EXPERT not in data:
            return None
        is_kept = torch.zeros(storage.max_size, dtype=torch.bool)
        if len(storage):
            is_kept[: len(storage)] = storage.column(keys.IS_EXPERT).reshape(-1)
        if not (is_kept.any() or data[keys.IS_EXPERT].any()):
            return None
        order = torch.arange(self._cursor, self._cursor + storage.max_size) % storage.max_size
        return order[~is_kept[order]]
