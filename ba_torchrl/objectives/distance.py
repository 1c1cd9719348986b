"""Distances of a policy's action from the expert's."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from ba_torchrl.core.choices import ActionDistance
from ba_torchrl.core.errors import BatchError


def action_distance(action: Tensor, expert_action: Tensor, kind: ActionDistance) -> Tensor:
    """Return the distance of actions from the expert's, the mean over components, [...].

    With a = tanh(u), "mse" is (a - a_e)^2. Its derivative with respect to u, 2 (a - a_e)(1 - a^2),
    vanishes at both ends of the range, so a policy that is driven to the wrong end stays there.
    "kl" is twice the Kullback-Leibler divergence of Bernoulli distributions with the probabilities
    (1 + a_e) / 2 and (1 + a) / 2. It is convex in u with the derivative 2 (a - a_e), and equals the
    squared error for small actions.

    Args:
        action: [..., A] in (-1, 1).
        expert_action: [..., A] in [-1, 1].
        kind: "mse" or "kl".
    """
    if action.shape[-1] != expert_action.shape[-1]:
        raise BatchError(
            f"the policy's actions have {action.shape[-1]} components, and the expert's "
            f"{expert_action.shape[-1]}"
        )
    if kind == "mse":
        return (action - expert_action).square().mean(dim=-1)
    expert, policy = (1 + expert_action.to(action).clamp(-1, 1)) / 2, (1 + action) / 2
    cross_entropy = F.binary_cross_entropy(policy, expert, reduction="none")
    entropy = F.binary_cross_entropy(expert, expert, reduction="none")
    return 2 * (cross_entropy - entropy).mean(dim=-1)
