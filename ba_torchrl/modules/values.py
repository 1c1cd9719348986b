"""Values of states and actions, from the encoder and the critic of an actor-critic network."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class ActionValue(nn.Module):
    """The value of an action: the first critic's.

    Args:
        encoder: from the observation to features [..., F].
        critic: from features and action to values [..., K].
    """

    def __init__(self, encoder: nn.Module, critic: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder
        self.critic = critic

    def forward(self, *observation_and_action: Tensor) -> Tensor:
        """Return values [..., 1] of the observation's entries and, last, the action [..., A]."""
        *observation, action = observation_and_action
        return self.critic(self.encoder(*observation), action)[..., :1]


class StateValue(nn.Module):
    """The value of a state: the first critic's at the action zero.

    Zero is invariant under rotations, so the value of an equivariant network is invariant.

    Args:
        encoder: from the observation to features [..., F].
        critic: from features and action to values [..., K].
        action_size: number of action components.
    """

    def __init__(self, encoder: nn.Module, critic: nn.Module, action_size: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.critic = critic
        self.action_size = action_size

    def forward(self, *observation: Tensor) -> Tensor:
        """Return values [..., 1] of the observation's entries."""
        features = self.encoder(*observation)
        zero = torch.zeros(*features.shape[:-1], self.action_size).to(features)
        return self.critic(features, zero)[..., :1]
