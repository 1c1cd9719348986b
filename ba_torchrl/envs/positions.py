"""The position of an environment in its episodes, which another process can continue from."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from ba_torchrl.core import keys
from ba_torchrl.core.errors import SimulationError

Position = dict[str, Any]
"""``seed``; ``episode``, the number of the first of some episodes; and ``actions``, float32
[T, A], of each of them up to the present. They are the current episode and, where it continues with
the objects of earlier episodes, these as well."""


class RecordedPosition:
    """Mix-in of environments: records the actions, and continues from a recorded position.

    The episode is played again with the same actions, which gives the same bits in any process.
    Reading the position does not affect the simulation, unlike `BulletArmEnv.get_state`.
    """

    copied_attributes = ("_first_episode", "_played", "_resumed")
    _first_episode = 0
    _played: list[list[torch.Tensor]] | None = None
    _resumed: TensorDict | None = None

    def get_position(self) -> Position:
        """Return the position.

        Raises:
            SimulationError: the environment was not reset, or its state was saved or set by other
                means, after which the actions do not determine it.
        """
        if not self._played:
            raise SimulationError("the actions since the last reset do not determine the state")
        size = self.actions.size
        return {
            "seed": self.base_seed,
            "episode": self._first_episode,
            "actions": [
                np.stack([action.numpy() for action in actions])
                if actions
                else np.zeros((0, size), dtype=np.float32)
                for actions in self._played
            ],
        }

    def continue_from(self, position: Position) -> None:
        """Play the episodes of a position again; the next `reset` returns its observation.

        Args:
            position: of an environment of the same task and parameters.
        """
        self._set_seed(position["seed"])
        self._episode = position["episode"]
        self._episodes.forget()
        for actions in position["actions"]:
            self._reset()
            for action in actions:
                self._step(TensorDict({keys.ACTION: torch.from_numpy(action.copy())}, []))
        self._resumed = self._tensordict(self._observation)

    def _get_state(self) -> Any:
        self._played = None
        return super()._get_state()

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        self._first_episode, self._played, self._resumed = 0, [], None

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        seed: int | None = None,
        set_state: bool = False,
        **options: Any,
    ) -> TensorDict:
        if set_state:
            restored = super()._reset(tensordict, set_state=True, **options)
            self._played = self._resumed = None
            return restored
        if self._resumed is not None and seed is None:
            resumed, self._resumed = self._resumed, None
            return resumed
        scene = self._episodes.scene
        depends = scene is not None and scene.task.continues
        faults = self.faults
        result = super()._reset(tensordict, seed=seed, **options)
        if not depends or self.faults > faults:  # a fault builds a new world
            self._first_episode, self._played = self._episode - 1, [[]]
        elif self._played is not None:
            self._played.append([])
        return result

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self._resumed = None
        faults = self.faults
        result = super()._step(tensordict)
        if self.faults > faults:  # the next episode is in a new world
            self._first_episode, self._played = self._episode, []
        elif self._played is not None:
            self._played[-1].append(tensordict.get(keys.ACTION).detach().cpu().clone())
        return result
