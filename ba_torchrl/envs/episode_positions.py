"""The position of an environment in its episodes, from which copies and other processes go on."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from tensordict import NonTensorData, TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from typing_extensions import Self

from ba_torchrl.core import keys
from ba_torchrl.core.errors import SimulationError
from ba_torchrl.envs.episodes import EnvState
from ba_torchrl.envs.settings import ResolvedEnv

EpisodePosition = dict[str, Any]
"""``seed``; ``episode``, the number of the first of some episodes; and ``actions``, float32
[T, A], of each of them up to the present. They are the current episode and, where it continues with
the objects of earlier episodes, these as well; none before the first episode and after a fault. A
collection adds ``carried``, what the policy carries to the next step."""


class RecordedPosition:
    """Mix-in of environments: records the actions, and continues from a recorded position.

    The episode is played again with the same actions, which gives the same bits in any process.
    Reading the position does not affect the simulation, unlike `BulletArmEnv.get_state`.

    `copy.copy`, `copy.deepcopy` and `pickle` give an independent environment at the same position,
    with a simulator of its own, without a window; where the actions do not determine the position,
    in the same state. To look ahead in one environment, `get_state` and
    ``reset(state, set_state=True)`` are faster.
    """

    _first_episode = 0
    _played: list[list[torch.Tensor]] | None = None
    """Actions of each episode of the position; None if they do not determine the state."""
    _resumed: TensorDict | None = None

    def get_position(self) -> EpisodePosition:
        """Return the position.

        Raises:
            SimulationError: the state was saved or set by other means since the last reset, or the
                seed was set, after which the actions do not determine it.
        """
        if self._episodes.scene is None:
            return {"seed": self.base_seed, "episode": self._episode, "actions": []}
        if self._played is None:
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

    def continue_from(self, position: EpisodePosition) -> None:
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
        if position["actions"]:
            self._resumed = self._tensordict(self._observation)

    def __copy__(self) -> Self:
        return copy.deepcopy(self)

    def __reduce__(self) -> tuple[Any, ...]:
        is_determined = self._played is not None or self._episodes.scene is None
        start = self.get_position() if is_determined else self._get_state()
        attributes = {name: getattr(self, name) for name in ("run_type_checks", "training")}
        if self._resumed is None:
            attributes["_resumed"] = None
        resolved = self.resolved.changed(render=False)
        return _make_copy, (type(self), resolved, start, attributes, self.device)

    def _get_state(self) -> EnvState:
        self._played = None
        return super()._get_state()

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        self._played = self._resumed = None

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
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None and not mask.any() and self._observation:
            return self._tensordict(self._observation, **self._ends)
        if self._resumed is not None and seed is None:
            resumed, self._resumed = self._resumed, None
            return resumed
        scene = self._episodes.scene
        has_objects = scene is not None and scene.task.continues
        depends = has_objects and seed is None and self._episode > 0
        faults = self.faults
        result = super()._reset(tensordict, seed=seed, **options)
        if not depends or self.faults > faults:  # a fault builds a new world
            self._first_episode, self._played = self._episode - 1, [[]]
        elif self._played is not None:
            self._played.append([])
        return result

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self._resumed = None
        result = super()._step(tensordict)
        if self._played is not None:
            self._played[-1].append(tensordict.get(keys.ACTION).detach().cpu().clone())
        return result


def _make_copy(
    cls: type[EnvBase],
    resolved: ResolvedEnv,
    start: EpisodePosition | EnvState,
    attributes: dict[str, Any],
    device: torch.device | None,
) -> EnvBase:
    """Make an environment at a position or in a state, with some attributes of another one."""
    env = cls(resolved)
    if device is not None:
        env = env.to(device)
    if isinstance(start, EnvState):
        env._set_state(TensorDict({keys.STATE: NonTensorData(start)}, []))
    else:
        env.continue_from(start)
    for name, value in attributes.items():
        setattr(env, name, value)
    return env
