"""Q-learning where an action is chosen level by level, with demonstrations (appendix E, G.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from ba_torchrl.envs import keys
from ba_torchrl.objectives.transitions import TransitionLoss

Demonstrations = Literal["none", "dqfd", "sdqfd", "adet"]
"""What the loss asks of the experts' actions beside the TD error."""


class LevelValues(Protocol):
    """A module that gives the values of an action's choices, level by level."""

    in_keys: list[NestedKey]
    """Of the observation, in the order of the arguments."""

    def __call__(self, *observation_and_action: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return each level's values [B, N] and the action's choice among them [B].

        The levels before are as the action chose them.
        """
        ...

    def greedy(self, *observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return the choices of greatest value, level after level, and the last one's value.

        The value is [B, 1].
        """
        ...


def large_margin(q: Tensor, chosen: Tensor, is_expert: Tensor, margin: float) -> Tensor:
    """Return the margin loss of DQfD: by how much any action comes too near to the expert's.

    max_a [Q(a) + margin * 1(a != a_e)] - Q(a_e), averaged over the experts' samples.

    Args:
        q: values of all actions [B, N].
        chosen: the stored action [B].
        is_expert: bool [B].
        margin: the experts' actions shall be better by this much.
    """
    of_chosen = q.gather(1, chosen[:, None])
    is_other = torch.ones_like(q).scatter_(1, chosen[:, None], 0.0)
    excess = (q + margin * is_other).amax(dim=1) - of_chosen[:, 0]
    return _mean_over(excess, is_expert)


def strict_large_margin(q: Tensor, chosen: Tensor, is_expert: Tensor, margin: float) -> Tensor:
    """Return the margin loss of SDQfD: it presses on every action that comes too near.

    The mean of Q(a) - Q(a_e) + margin over {a != a_e: Q(a) > Q(a_e) - margin}, zero where there
    is none, averaged over the whole batch, in which samples of the policy count as zero.

    Args:
        q: values of all actions [B, N].
        chosen: the stored action [B].
        is_expert: bool [B].
        margin: the experts' actions shall be better by this much.
    """
    gap = q - q.gather(1, chosen[:, None]) + margin
    violates = (gap > 0).scatter(1, chosen[:, None], False)
    violates &= is_expert[:, None]
    count = violates.sum(dim=1).clamp_min(1)
    return (torch.where(violates, gap, 0.0).sum(dim=1) / count).mean()


def cross_entropy(q: Tensor, chosen: Tensor, is_expert: Tensor, beta: float) -> Tensor:
    """Return the loss of ADET: the cross-entropy of softmax(beta Q) with the expert's action.

    Averaged over the experts' samples.

    Args:
        q: values of all actions [B, N].
        chosen: the stored action [B].
        is_expert: bool [B].
        beta: inverse temperature.
    """
    return _mean_over(F.cross_entropy(beta * q, chosen, reduction="none"), is_expert)


class LevelDQNLoss(TransitionLoss):
    """Deep Q-learning on levels of choices, alone or with demonstrations (appendix G.1).

    Every level regresses the value of what the stored action chose, the levels before being as
    it chose them, towards one target: the value that the last level of the *target* network gives
    to the choices which that network finds best, level after level::

        y        = r + gamma (1 - terminated) Q'_last(s', a'_1, ..., a'_k)
        loss_qvalue        = sum over levels of the mean of w_i huber(Q_level(s_i, a_i) - y_i)
        loss_demonstration = weight * sum over levels of the chosen term on the experts' samples

    A truncated step bootstraps, a terminated one does not. ``forward`` also writes the priority,
    the mean of |Q_level - y| over the levels, of shape [B, 1], into its input.

    Args:
        value_network: gives the levels' values.
        demonstrations: "dqfd" `large_margin`, "sdqfd" `strict_large_margin`, "adet"
            `cross_entropy`, or "none" for plain DQN, whose batches may lack the expert flag.
        demonstration_weight: factor on that term.
        margin: of the margin terms.
        first_beta: of ADET at the first level.
        later_beta: of ADET at the later ones.
    """

    @dataclass
    class _AcceptedKeys:
        """Entries that ``set_keys`` can rename; those of the next state are nested in "next"."""

        action: NestedKey = keys.ACTION
        reward: NestedKey = keys.REWARD
        done: NestedKey = keys.DONE
        terminated: NestedKey = keys.TERMINATED
        is_expert: NestedKey = keys.IS_EXPERT
        value: NestedKey = "state_value"
        priority: NestedKey = keys.TD_ERROR
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    value_network: nn.Module
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    out_keys = (
        "loss_qvalue",
        "loss_demonstration",
        "demonstration_error",
        "td_error",
        "q_value",
        "target_value",
    )

    def __init__(
        self,
        value_network: LevelValues,
        *,
        demonstrations: Demonstrations = "sdqfd",
        demonstration_weight: float = 0.1,
        margin: float = 0.1,
        first_beta: float = 100.0,
        later_beta: float = 1.0,
    ) -> None:
        super().__init__()
        self.demonstrations = demonstrations
        self.demonstration_weight = demonstration_weight
        self.margin = margin
        self.first_beta = first_beta
        self.later_beta = later_beta
        self.convert_to_functional(value_network, "value_network", create_target_params=True)
        # Not left to the first forward pass: its gamma is part of the state_dict.
        self.make_value_estimator(device=self._default_device)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries that ``forward`` needs."""
        names = self._transition_keys(self.value_network.in_keys)
        return names if self.demonstrations == "none" else [*names, self.tensor_keys.is_expert]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses and detached diagnostics of a batch of transitions.

        Args:
            tensordict: transitions [B]; gets the priority written into it.

        Returns:
            Scalars ``loss_qvalue`` and ``loss_demonstration``, whose sum is to be minimised; and
            without gradient ``demonstration_error`` (the term before its weight), ``td_error``,
            ``q_value`` and ``target_value`` (means over the batch; levels averaged).

        Raises:
            KeyError: an entry is missing, the expert flag included unless built without a term.
        """
        target = self._target(tensordict)
        with self.value_network_params.to_module(self.value_network, preserve_module_state=False):
            levels = self.value_network(
                *(tensordict[key] for key in self.value_network.in_keys),
                tensordict[self.tensor_keys.action],
            )
        q = torch.stack([values.gather(1, chosen[:, None]) for values, chosen in levels], dim=-1)
        errors = F.huber_loss(q, target[..., None].expand_as(q), reduction="none")
        weights = self._importance_weights(tensordict)
        errors = errors if weights is None else weights[:, None, None] * errors
        difference = (q.detach() - target[..., None]).abs().mean(dim=-1)
        tensordict.set(self.tensor_keys.priority, difference)
        demonstration = self._demonstration_error(tensordict, levels)
        return TensorDict(
            {
                "loss_qvalue": errors.mean(dim=(0, 1)).sum(),
                "loss_demonstration": self.demonstration_weight * demonstration,
                "demonstration_error": demonstration.detach(),
                "td_error": difference.mean(),
                "q_value": q.detach().mean(),
                "target_value": target.mean(),
            }
        )

    @torch.no_grad()
    def _target(self, tensordict: TensorDictBase) -> Tensor:
        """Return y [B, 1]."""
        following = tensordict[keys.NEXT]
        params = self.target_value_network_params
        with params.to_module(self.value_network, preserve_module_state=False):
            observation = (following[key] for key in self.value_network.in_keys)
            _, value = self.value_network.greedy(*observation)
        return self.value_estimator.value_estimate(tensordict, next_value=value)

    def _demonstration_error(
        self, tensordict: TensorDictBase, levels: list[tuple[Tensor, Tensor]]
    ) -> Tensor:
        """Return the sum of the levels' terms, zero without experts in the batch."""
        if self.demonstrations == "none":
            return levels[0][0].new_zeros(())
        is_expert = tensordict[self.tensor_keys.is_expert].reshape(-1)
        terms = []
        for number, (q, chosen) in enumerate(levels):
            if self.demonstrations == "adet":
                beta = self.later_beta if number else self.first_beta
                terms.append(cross_entropy(q, chosen, is_expert, beta))
            elif self.demonstrations == "dqfd":
                terms.append(large_margin(q, chosen, is_expert, self.margin))
            else:
                terms.append(strict_large_margin(q, chosen, is_expert, self.margin))
        return torch.stack(terms).sum()


def _mean_over(values: Tensor, chosen: Tensor) -> Tensor:
    """Return the mean of the values [B] where ``chosen``, zero if nowhere."""
    share = chosen.to(values.dtype)
    return (values * share).sum() / share.sum().clamp_min(1)
