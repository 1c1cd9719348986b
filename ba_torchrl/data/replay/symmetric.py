"""Symmetric sampling: half of every batch from demonstrations, half from online transitions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBufferEnsemble

from ba_torchrl.data.replay.buffer import FrameReplayBuffer, make_replay_buffer
from ba_torchrl.data.replay.codecs import ImageCodec
from ba_torchrl.envs import keys
from ba_torchrl.errors import ConfigError

_NAMES = ("expert", "online")


class SymmetricReplay(ReplayBufferEnsemble):
    """Half of every batch from demonstrations, half from online transitions (appendix G.1).

    Demonstrations are never overwritten. While one buffer is empty, the whole batch is drawn from
    the other. A batch of odd size has one demonstration more. In TorchRL's ensemble and
    ``OfflineToOnlineReplayBuffer``, both buffers share a generator or use the global one, and
    batches have even sizes; here each buffer has a separate generator.

    Args:
        capacity: number of online transitions, and of demonstrations.
        batch_size: of a sample.
        codecs: codec of each image by key; the acting policy must use the same.
        seed: of the draws.
        returns_codes: samples hold the images' codes instead of decoded images.
    """

    def __init__(
        self,
        capacity: int,
        batch_size: int,
        *,
        codecs: Mapping[str, ImageCodec],
        seed: int,
        returns_codes: bool = False,
    ) -> None:
        self.expert, self.online = (
            make_replay_buffer(
                capacity,
                None,
                codecs=codecs,
                seed=2 * seed + i,
                prioritized=False,
                returns_codes=returns_codes,
            )
            for i, _ in enumerate(_NAMES)
        )
        super().__init__(self.expert, self.online, batch_size=batch_size, collate_fn=torch.cat)
        for buffer in (self.expert, self.online):
            buffer.set_rng(buffer._rng)  # the ensemble has replaced the samplers' generators

    def __len__(self) -> int:
        """Number of transitions in both buffers."""
        return len(self.expert) + len(self.online)

    @property
    def stored_keys(self) -> frozenset[NestedKey]:
        """Entries of the stored transitions, the same in both buffers; empty before the first."""
        return self.expert.stored_keys | self.online.stored_keys

    def extend(self, data: TensorDictBase, *, update_priority: bool | None = None) -> None:
        """Add transitions [N], each to the buffer that its ``is_expert`` flag selects.

        Args:
            data: transitions.
            update_priority: see TorchRL; the buffers have no priorities.

        Raises:
            ConfigError: the new demonstrations exceed the free capacity.
            ReplaySchemaError: entries, types or shapes are not those of the stored ones.
        """
        is_expert = data[keys.IS_EXPERT].reshape(-1)
        room = self.expert.storage.max_size - len(self.expert)
        if int(is_expert.sum()) > room:
            raise ConfigError(
                f"{int(is_expert.sum())} more demonstrations do not fit: {room} places of "
                f"{self.expert.storage.max_size} are left; raise buffer_size"
            )
        for buffer, chosen in ((self.expert, is_expert), (self.online, ~is_expert)):
            if chosen.any():
                buffer.extend(data[chosen])

    def add(self, data: TensorDictBase) -> None:
        """Add one transition."""
        self.extend(data.unsqueeze(0))

    def _sample(self, batch_size: int) -> tuple[TensorDictBase, dict[str, Any]]:
        """Return a batch of transitions [batch_size], demonstrations first.

        Raises:
            RuntimeError: the replay is empty.
        """
        if not len(self):
            raise RuntimeError("cannot sample from an empty replay")
        online = batch_size // 2 if len(self.expert) else batch_size
        online = online if len(self.online) else 0
        counts = ((self.expert, batch_size - online), (self.online, online))
        return torch.cat([buffer.sample(count) for buffer, count in counts if count]), {}

    def dumps(self, path: str | Path) -> None:
        """Write both buffers into a folder, which is created if needed."""
        for name, buffer in self._buffers():
            buffer.dumps(Path(path) / name)

    def loads(self, path: str | Path) -> None:
        """Read both buffers from a folder that ``dumps`` wrote."""
        for name, buffer in self._buffers():
            buffer.loads(Path(path) / name)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of both buffers."""
        return {name: buffer.state_dict() for name, buffer in self._buffers()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore both buffers."""
        for name, buffer in self._buffers():
            buffer.load_state_dict(state_dict[name])

    def _buffers(self) -> zip[tuple[str, FrameReplayBuffer]]:
        return zip(_NAMES, (self.expert, self.online), strict=True)


def count_demonstrations(replay: SymmetricReplay | FrameReplayBuffer) -> int:
    """Return the number of transitions in a replay with the flag ``is_expert``."""
    if isinstance(replay, SymmetricReplay):
        return len(replay.expert)
    return int(replay.storage.column(keys.IS_EXPERT).sum()) if len(replay) else 0
