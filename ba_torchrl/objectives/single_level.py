"""Adapter from a TorchRL Q-value actor to the level-by-level losses."""

from __future__ import annotations

from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import QValueActor


class SingleLevelValues(nn.Module):
    """The action values of a TorchRL `QValueActor` as a single level of choices.

    Args:
        actor: with the action space "one_hot" or "categorical".

    Raises:
        ValueError: the actor has another action space.
    """

    def __init__(self, actor: QValueActor) -> None:
        super().__init__()
        values, choice = actor[0], actor[1]
        if choice.action_space not in ("one_hot", "categorical"):
            raise ValueError(
                f"the action space must be one_hot or categorical, got {choice.action_space!r}"
            )
        self.values = values
        self.is_one_hot = choice.action_space == "one_hot"
        self.in_keys: list[NestedKey] = list(values.in_keys)
        self._value_key = choice.in_keys[0]

    def greedy(self, *observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return the choices [B, 1] of greatest value, and their values [B, 1]."""
        value, best = self._action_values(observation).max(dim=1, keepdim=True)
        return best, value

    def forward(self, *observation_and_action: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the values of all actions [B, N], and the index of the given action [B]."""
        *observation, action = observation_and_action
        chosen = action.long().argmax(dim=-1) if self.is_one_hot else action.reshape(len(action))
        return [(self._action_values(observation), chosen.long())]

    def _action_values(self, observation: list[Tensor] | tuple[Tensor, ...]) -> Tensor:
        data = TensorDict({}, [len(observation[0])])
        for key, value in zip(self.in_keys, observation, strict=True):
            data.set(key, value)
        return self.values(data)[self._value_key]
