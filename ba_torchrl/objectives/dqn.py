"""Q-learning with actions chosen level by level, and demonstrations (appendix E, G.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import QValueActor

from ba_torchrl.envs import keys
from ba_torchrl.objectives.base import (
    Reduction,
    TransitionLoss,
    WeightedTerms,
    WeightNorm,
    reduce_loss,
    reduce_over,
    weighted,
)
from ba_torchrl.objectives.single_level import SingleLevelValues

Demonstrations = Literal["none", "dqfd", "sdqfd", "adet"]
"""The loss on demonstrated actions that is added to the TD loss."""


class LevelValues(Protocol):
    """A module that computes the values of the choices of an action, level by level."""

    in_keys: list[NestedKey]
    """Keys of the observation, in the order of the arguments."""

    def __call__(self, *observation_and_action: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the values [B, N] of each level and the index of the action's choice [B].

        The values of a level are conditioned on the action's choices at the levels before.
        """
        ...

    def greedy(self, *observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return the greedy choices, level after level, and the last one's value [B, 1]."""
        ...


def large_margin(
    q: Tensor,
    chosen: Tensor,
    is_expert: Tensor,
    margin: float,
    reduction: Reduction = "mean",
    weights: Tensor | None = None,
) -> Tensor:
    """Return the margin loss of DQfD (appendix E).

    max_a [Q(a) + margin * 1(a != a_e)] - Q(a_e); the mean is over the demonstrations.

    Args:
        q: values of all actions [B, N].
        chosen: the stored action [B].
        is_expert: bool [B].
        margin: least difference of Q(a_e) to the other values.
        reduction: of the samples' losses; zero for samples that are not demonstrations.
        weights: [B] of the samples' losses.
    """
    of_chosen = q.gather(1, chosen[:, None])
    is_other = torch.ones_like(q).scatter_(1, chosen[:, None], 0.0)
    excess = (q + margin * is_other).amax(dim=1) - of_chosen[:, 0]
    return reduce_over(weighted(excess, weights), is_expert, reduction)


def strict_large_margin(
    q: Tensor,
    chosen: Tensor,
    is_expert: Tensor,
    margin: float,
    reduction: Reduction = "mean",
    weights: Tensor | None = None,
) -> Tensor:
    """Return the margin loss of SDQfD, which applies to every violating action (appendix E).

    The mean of Q(a) - Q(a_e) + margin over {a != a_e: Q(a) > Q(a_e) - margin}, zero if that set is
    empty. The loss is averaged over the whole batch, with zero for samples that are not
    demonstrations.

    Args:
        q: values of all actions [B, N].
        chosen: the stored action [B].
        is_expert: bool [B].
        margin: least difference of Q(a_e) to the other values.
        reduction: of the samples' losses.
        weights: [B] of the samples' losses.
    """
    gap = q - q.gather(1, chosen[:, None]) + margin
    violates = (gap > 0).scatter(1, chosen[:, None], False)
    violates &= is_expert[:, None]
    count = violates.sum(dim=1).clamp_min(1)
    losses = torch.where(violates, gap, 0.0).sum(dim=1) / count
    return reduce_loss(weighted(losses, weights), reduction)


def cross_entropy(
    q: Tensor,
    chosen: Tensor,
    is_expert: Tensor,
    beta: float,
    reduction: Reduction = "mean",
    weights: Tensor | None = None,
) -> Tensor:
    """Return the loss of ADET: the cross-entropy of softmax(beta Q) with the expert's action.

    The mean is over the demonstrations.

    Args:
        q: values of all actions [B, N].
        chosen: the stored action [B].
        is_expert: bool [B].
        beta: inverse temperature.
        reduction: of the samples' losses; zero for samples that are not demonstrations.
        weights: [B] of the samples' losses.
    """
    losses = F.cross_entropy(beta * q, chosen, reduction="none")
    return reduce_over(weighted(losses, weights), is_expert, reduction)


class LevelDQNLoss(TransitionLoss):
    """Deep Q-learning on levels of choices, with or without demonstrations (appendix G.1).

    At each level, the value of the stored action, conditioned on its choices at the levels before,
    is regressed to the same target: the last level's value of the choices that are greedy under the
    *target* network, level after level::

        y        = r + gamma (1 - terminated) Q'_last(s', a'_1, ..., a'_k)
        loss_qvalue        = sum over levels of the mean of w_i huber(Q_level(s_i, a_i) - y_i)
        loss_demonstration = weight * sum over levels of the chosen term on the experts' samples

    The target bootstraps on truncated steps and not on terminated ones. ``forward`` also writes the
    priority, the mean of |Q_level - y| over the levels, of shape [B, 1], into its input.

    Args:
        value_network: computes the values of the levels. TorchRL's `QValueActor` is used as a
            single level, see `SingleLevelValues`.
        demonstrations: "dqfd" `large_margin`, "sdqfd" `strict_large_margin`, "adet"
            `cross_entropy`, or "none" for plain DQN, which needs no expert flag in the batch.
        demonstration_weight: weight of that term.
        margin: margin of "dqfd" and "sdqfd".
        first_beta: inverse temperature of "adet" at the first level.
        later_beta: inverse temperature of "adet" at later levels.
        reduction: of the samples' losses; the formulas above are "mean".
        weighted_terms: terms that the importance weights multiply; "all" includes
            loss_demonstration.
        weight_norm: statistic by which a batch's weights are divided.
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
        value_network: LevelValues | QValueActor,
        *,
        demonstrations: Demonstrations = "sdqfd",
        demonstration_weight: float = 0.1,
        margin: float = 0.1,
        first_beta: float = 100.0,
        later_beta: float = 1.0,
        reduction: Reduction | None = None,
        weighted_terms: WeightedTerms = "critic_and_policy",
        weight_norm: WeightNorm = "max",
    ) -> None:
        super().__init__(reduction, weighted_terms=weighted_terms, weight_norm=weight_norm)
        if isinstance(value_network, QValueActor):
            value_network = SingleLevelValues(value_network)
        self.demonstrations = demonstrations
        self.demonstration_weight = demonstration_weight
        self.margin = margin
        self.first_beta = first_beta
        self.later_beta = later_beta
        self.convert_to_functional(value_network, "value_network", create_target_params=True)
        # Made before the first forward pass, because its gamma is part of the state_dict.
        self.make_value_estimator(device=self._default_device)

    def _required_keys(self) -> list[NestedKey]:
        names = self._transition_keys(self.value_network.in_keys)
        return names if self.demonstrations == "none" else [*names, self.tensor_keys.is_expert]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses and detached diagnostics of a batch of transitions.

        Args:
            tensordict: transitions [B]; gets the priority written into it.

        Returns:
            ``loss_qvalue`` and ``loss_demonstration``, scalars or, with the reduction "none", of
            shape [B], whose sum is minimised; and without gradient the scalars
            ``demonstration_error`` (the term before its weight), ``td_error``, ``q_value`` and
            ``target_value`` (means over the batch; levels averaged).

        Raises:
            KeyError: an entry is missing, such as the expert flag if there is a term on
                demonstrations.
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
        td_weights = weights.of("critic")
        errors = weighted(errors, None if td_weights is None else td_weights[:, None, None])
        difference = (q.detach() - target[..., None]).abs().mean(dim=-1)
        tensordict.set(self.tensor_keys.priority, difference)
        demonstration = self._demonstration_error(
            tensordict, levels, self.reduction, weights.of("all")
        )
        return TensorDict(
            {
                "loss_qvalue": self._sum_over_levels(errors[:, 0]),
                "loss_demonstration": self.demonstration_weight * demonstration,
                "demonstration_error": self._demonstration_error(
                    tensordict, [(q.detach(), chosen) for q, chosen in levels], "mean"
                ),
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

    def _sum_over_levels(self, losses: Tensor) -> Tensor:
        """Return losses [B, levels] summed over the levels and reduced over the batch."""
        if self.reduction == "none":
            return losses.sum(dim=-1)
        return (losses.mean(dim=0) if self.reduction == "mean" else losses.sum(dim=0)).sum()

    def _demonstration_error(
        self,
        tensordict: TensorDictBase,
        levels: list[tuple[Tensor, Tensor]],
        reduction: Reduction,
        weights: Tensor | None = None,
    ) -> Tensor:
        """Return the sum of the levels' terms, zero without demonstrations in the batch."""
        if self.demonstrations == "none":
            return reduce_loss(levels[0][0].new_zeros(len(levels[0][0])), reduction)
        is_expert = tensordict[self.tensor_keys.is_expert].reshape(-1)
        terms = []
        for number, (q, chosen) in enumerate(levels):
            if self.demonstrations == "adet":
                beta = self.later_beta if number else self.first_beta
                terms.append(cross_entropy(q, chosen, is_expert, beta, reduction, weights))
            elif self.demonstrations == "dqfd":
                terms.append(large_margin(q, chosen, is_expert, self.margin, reduction, weights))
            else:
                terms.append(
                    strict_large_margin(q, chosen, is_expert, self.margin, reduction, weights)
                )
        return torch.stack(terms).sum(dim=0)
