"""A round-robin writer of the replay that never overwrites demonstrations."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictRoundRobinWriter

from ba_torchrl.envs import keys
from ba_torchrl.errors import ConfigError


class ExpertKeepingWriter(TensorDictRoundRobinWriter):
    """TorchRL's round-robin writer, which skips demonstrations when the storage is full.

    A new transition overwrites the oldest one whose ``is_demonstration`` flag is not set. Data
    without this entry are written as by TorchRL's writer.
    """

    def select_fitting(self, data: TensorDictBase) -> TensorDictBase:
        """Return the transitions that fit: all demonstrations, and the newest of the others.

        Args:
            data: transitions [N].

        Raises:
            ConfigError: stored and new demonstrations exceed the capacity.
        """
        indices = self._writable_indices(data)
        excess = 0 if indices is None else len(data) - len(indices)
        if excess <= 0:
            return data
        others = (~data[keys.IS_DEMONSTRATION].reshape(-1)).nonzero().reshape(-1)
        if not len(indices) or excess > len(others):
            raise ConfigError(
                f"demonstrations fill the replay of {self._storage.max_size} transitions, and "
                f"{len(data)} more do not fit; raise buffer_size"
            )
        is_chosen = torch.ones(len(data), dtype=torch.bool, device="cpu")
        is_chosen[others[:excess]] = False
        return data[is_chosen]

    def extend(self, data: TensorDictBase) -> Tensor:
        """Write transitions [N] that `select_fitting` returned; return their indices, int64 [N]."""
        indices = self._writable_indices(data)
        if indices is None:
            return super().extend(data)
        index = indices[: len(data)]
        self._cursor = (int(index[-1]) + 1) % self._storage.max_size
        self._write_count += len(data)
        data.set("index", index)
        self._storage.set(index, data)
        self._mark_update_entities(index)
        return index

    def _writable_indices(self, data: TensorDictBase) -> Tensor | None:
        """Return the indices to overwrite, oldest first; None if TorchRL's order applies."""
        storage = self._storage
        if len(storage) + len(data) <= storage.max_size or keys.IS_DEMONSTRATION not in data:
            return None
        is_kept = torch.zeros(storage.max_size, dtype=torch.bool, device="cpu")
        if len(storage):
            is_kept[: len(storage)] = storage.column(keys.IS_DEMONSTRATION).reshape(-1)
        if not (is_kept.any() or data[keys.IS_DEMONSTRATION].any()):
            return None
        order = (
            torch.arange(self._cursor, self._cursor + storage.max_size, device="cpu")
            % storage.max_size
        )
        return order[~is_kept[order]]
