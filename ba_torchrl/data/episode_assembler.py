"""Episodes of several environments, put together from batches of transitions."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from ba_torchrl.envs import keys


class EpisodeAssembler:
    """Holds transitions back until their episodes end, and flags those of successful episodes.

    Where the next step of an episode is missing, as after the replacement of a worker, the part
    before counts as an unsuccessful episode, and the part after as another episode.
    """

    def __init__(self) -> None:
        self._running: dict[int, list[TensorDictBase]] = {}

    def __len__(self) -> int:
        """Number of transitions of the episodes that have not ended."""
        return sum(map(len, self._running.values()))

    def complete(self, data: TensorDictBase) -> TensorDictBase:
        """Add transitions, and return those of the episodes that have ended.

        Args:
            data: [N], those of an environment in their order, with ``env_index``, ``step_count``
                and, under "next", ``done`` and ``success``.

        Returns:
            [M] transitions in the order in which their episodes ended, with ``is_expert`` set
            where the episode was successful.
        """
        ended = []
        for row in range(len(data)):
            transition = data[row : row + 1].clone()
            index = int(transition[keys.ENV_INDEX])
            running = self._running.setdefault(index, [])
            if running and transition[keys.STEP_COUNT] != running[-1][keys.STEP_COUNT] + 1:
                ended.append(self._flagged(index, is_successful=False))
                running = self._running.setdefault(index, [])
            running.append(transition)
            if bool(transition[keys.NEXT, keys.DONE]):
                is_successful = bool(transition[keys.NEXT, keys.SUCCESS])
                ended.append(self._flagged(index, is_successful=is_successful))
        if ended:
            return torch.cat(ended)
        return (
            data[:0].clone().set(keys.IS_EXPERT, torch.zeros(0, 1, dtype=torch.bool, device="cpu"))
        )

    def _flagged(self, index: int, *, is_successful: bool) -> TensorDictBase:
        """Return an environment's episode, which has ended, with its flag."""
        episode = torch.cat(self._running.pop(index))
        return episode.set(
            keys.IS_EXPERT, torch.full((len(episode), 1), is_successful, device="cpu")
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the transitions of the episodes that have not ended, by environment."""
        return {
            str(index): torch.cat(running).flatten_keys("/").to_dict()
            for index, running in self._running.items()
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""
        self._running = {}
        for index, entries in state.items():
            episode = TensorDict(entries, batch_size=[len(entries[keys.STEP_COUNT])])
            self._running[int(index)] = list(episode.unflatten_keys("/").split(1))
