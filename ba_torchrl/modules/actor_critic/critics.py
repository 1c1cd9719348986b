"""Critics beside the networks' own: ensembles (Ball et al., 2023; "RLPD"), values of states."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.modules.layers import XavierInitialised


class BatchedLinear(nn.Module):
    """A linear layer per head, computed for all heads together."""

    def __init__(self, heads: int, in_size: int, out_size: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(heads, in_size, out_size))
        self.bias = nn.Parameter(torch.empty(heads, out_size))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Xavier-initialise the weights of each head, and set the biases to zero."""
        bound = math.sqrt(6 / sum(self.weight.shape[1:]))
        nn.init.uniform_(self.weight, -bound, bound)
        nn.init.zeros_(self.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Return [..., heads, out_size] of x [..., heads, in_size]."""
        return torch.einsum("...hi,hio->...ho", x, self.weight) + self.bias


class FieldNorm(nn.Module):
    """Layer normalisation per head, over fields and their components.

    Each field has one scale and one shift, so that a permutation of each field's components by a
    group element commutes with the normalisation.
    """

    def __init__(self, heads: int, fields: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(heads, fields, 1))
        self.bias = nn.Parameter(torch.zeros(heads, fields, 1))

    def reset_parameters(self) -> None:
        """Set the scales to one and the shifts to zero."""
        nn.init.ones_(self.weight)
        nn.init.zeros_(self.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Return x [..., heads, fields, components], normalised."""
        return F.layer_norm(x, x.shape[-2:]) * self.weight + self.bias


def _unchanged(action: Tensor) -> Tensor:
    return action


class EnsembleCritic(XavierInitialised):
    """Values of an action from several critics on shared features.

    Each head has two hidden layers with layer normalisation before the ReLU. The hidden units of
    the first are fields with a component per rotation of a group; their maximum over the rotations
    is invariant. Without a group, fields have one component.

    Args:
        first: linear map from [features, action] to heads * fields * group_order channels.
        fields: fields of a head's first layer, and units of its second.
        group_order: components of a field.
        arrange: maps the action [..., A] to the order of components that ``first`` takes.
    """

    def __init__(
        self,
        first: nn.Module,
        heads: int,
        fields: int,
        group_order: int = 1,
        arrange: Callable[[Tensor], Tensor] = _unchanged,
    ) -> None:
        super().__init__()
        self.heads = heads
        self.first = first
        self.first_norm = FieldNorm(heads, fields)
        self.second = BatchedLinear(heads, fields, fields)
        self.second_norm = FieldNorm(heads, fields)
        self.values = BatchedLinear(heads, fields, 1)
        self._shape = (heads, fields, group_order)
        self._arrange = arrange

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Return values [..., heads] of features [..., F] and action [..., A]."""
        x = self.first(torch.cat([features, self._arrange(action)], dim=-1))
        x = F.relu(self.first_norm(x.unflatten(-1, self._shape))).amax(dim=-1)
        x = F.relu(self.second_norm(self.second(x)[..., None]))[..., 0]
        return self.values(x)[..., 0]


class ActionValue(nn.Module):
    """The first critic's value of an action, in one network of encoder and critic.

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
    """The value of a state: the first critic's value of the action zero.

    Zero is invariant under rotations, so the value of an equivariant network is invariant.

    Args:
        encoder: from the observation to features [..., F].
        critic: from features and action to values [..., K].
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
