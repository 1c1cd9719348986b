"""Symmetric sampling: half of every batch from demonstrations, half from online transitions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from ba_torchrl.core import keys
from ba_torchrl.core.files import StateFolder
from ba_torchrl.core.generators import seeded_generator
from ba_torchrl.data.replay.storage import OneProcess, stored_flags

_SIDES = ("expert", "online")


class SymmetricSampler(OneProcess, StateFolder, Sampler):
    """Draws half of every batch from demonstrations, half from online transitions (appendix G.1).

    Each half is drawn uniformly, with replacement, demonstrations first. While there are none of
    one kind, the whole batch is drawn from the other. A batch of odd size has one demonstration
    more. TorchRL's `OfflineToOnlineReplayBuffer` does not replace it: only its online part can be
    extended, not the other by imitated successes, and it has no state from which a run resumes.

    Args:
        seed: of the draws; each half has a separate generator, and that of the buffer is not used.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from ba_torchrl.data import SymmetricSampler
        >>> storage, sampler = LazyTensorStorage(100), SymmetricSampler(seed=0)
        >>> replay = TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=8)
        >>> steps = {"observation": torch.rand(20, 3), "is_demonstration": torch.arange(20) < 5}
        >>> steps = TensorDict(steps, [20])
        >>> index = replay.extend(steps)
        >>> int(replay.sample()["is_demonstration"].sum())
        4
    """

    def __init__(self, seed: int) -> None:
        self.generators = {side: seeded_generator(2 * seed + i) for i, side in enumerate(_SIDES)}

    def sample(
        self, storage: Storage, batch_size: int
    ) -> tuple[Tensor | tuple[Tensor, ...], dict[str, Any]]:
        """Return indices of transitions, int64 [batch_size], and nothing else.

        Args:
            storage: the storage that is sampled; with several dimensions, a tuple of indices is
                returned.
            batch_size: number of draws.

        Raises:
            RuntimeError: the storage is empty.
        """
        if not len(storage):
            raise RuntimeError("cannot sample from an empty replay")
        is_demonstration = stored_flags(storage, keys.IS_DEMONSTRATION)
        expert, online = (flags.nonzero()[:, 0] for flags in (is_demonstration, ~is_demonstration))
        count = batch_size // 2 if len(expert) else batch_size
        count = count if len(online) else 0
        halves = ((expert, batch_size - count), (online, count))
        index = [
            places[torch.randint(len(places), (n,), generator=generator, device="cpu")]
            for (places, n), generator in zip(halves, self.generators.values(), strict=True)
            if n
        ]
        index = torch.cat(index)
        return (torch.unravel_index(index, storage.shape) if storage.ndim > 1 else index), {}

    def state_dict(self) -> dict[str, Any]:
        """Return the states of the generators."""
        return {side: generator.get_state() for side, generator in self.generators.items()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the generators, from any device."""
        for side, generator in self.generators.items():
            generator.set_state(state_dict[side].cpu())

    def _empty(self) -> None:
        """Do nothing: the sampler holds no transitions."""
