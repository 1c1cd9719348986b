"""A replay of two halves: demonstrations, which stay, and what the policy has met."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from tensordict import TensorDictBase

from ba_torchrl.data.replay.buffer import FrameReplayBuffer, make_replay_buffer
from ba_torchrl.data.replay.codecs import ImageCodec
from ba_torchrl.envs import keys

_SIDES = ("expert", "online")


class SymmetricReplay:
    """Half of every batch from demonstrations, half from online transitions (appendix G.1).

    Demonstrations are never overwritten. While one side is empty, the other fills the batch; an
    odd transition comes from the demonstrations. TorchRL's ``OfflineToOnlineReplayBuffer`` splits
    likewise, but draws the online half from the global generator, so that no seed repeats it.

    Args:
        capacity: number of online transitions, and of demonstrations.
        batch_size: of a sample.
        codecs: how each kind of image is stored, by key; the acting policy must use the same.
        seed: of the draws.
    """

    def __init__(
        self, capacity: int, batch_size: int, *, codecs: Mapping[str, ImageCodec], seed: int
    ) -> None:
        self.batch_size = batch_size
        self.expert, self.online = (
            make_replay_buffer(capacity, None, codecs=codecs, seed=2 * seed + i, prioritized=False)
            for i, _ in enumerate(_SIDES)
        )

    def __len__(self) -> int:
        """Number of transitions of both sides."""
        return len(self.expert) + len(self.online)

    def extend(self, transitions: TensorDictBase) -> None:
        """Add transitions [N], each on the side that ``is_expert`` says.

        Raises:
            ValueError: there is no room for more demonstrations.
            ReplaySchemaError: entries, types or shapes are not those of the stored ones.
        """
        is_expert = transitions[keys.IS_EXPERT].reshape(-1)
        room = self.expert.storage.max_size - len(self.expert)
        if int(is_expert.sum()) > room:
            raise ValueError(
                f"{int(is_expert.sum())} more demonstrations do not fit: {room} places of "
                f"{self.expert.storage.max_size} are left; raise buffer_size"
            )
        for buffer, chosen in ((self.expert, is_expert), (self.online, ~is_expert)):
            if chosen.any():
                buffer.extend(transitions[chosen])

    def sample(self) -> TensorDictBase:
        """Return a batch of transitions [batch_size], demonstrations first.

        Raises:
            RuntimeError: the replay is empty.
        """
        if not len(self):
            raise RuntimeError("cannot sample from an empty replay")
        online = self.batch_size // 2 if len(self.expert) else self.batch_size
        online = online if len(self.online) else 0
        parts = [
            buffer.sample(count)
            for buffer, count in (
                (self.expert, self.batch_size - online),
                (self.online, online),
            )
            if count
        ]
        return torch.cat(parts)

    def dumps(self, path: str | Path) -> None:
        """Write both sides into a folder, made if missing."""
        for side in _SIDES:
            self._side(side).dumps(Path(path) / side)

    def loads(self, path: str | Path) -> None:
        """Read both sides from a folder that ``dumps`` wrote."""
        for side in _SIDES:
            self._side(side).loads(Path(path) / side)

    def _side(self, side: str) -> FrameReplayBuffer:
        return getattr(self, side)
