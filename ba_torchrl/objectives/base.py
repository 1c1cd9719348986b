"""The base class of losses on batches of single transitions."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import ValueEstimators
from torchrl.objectives.utils import default_value_kwargs, dispatch_value_estimator
from typing_extensions import Self

from ba_torchrl.core import keys
from ba_torchrl.core.choices import WeightedTerms, WeightNorm
from ba_torchrl.core.errors import check_choice
from ba_torchrl.objectives.networks import (
    EvalModeTargetsLoss,
    Reduction,
    checked_reduction,
)


class TransitionLoss(EvalModeTargetsLoss):
    """A loss with one-step targets, reduced over a batch by TorchRL's rules.

    Samples that a mask excludes (TorchRL's ``loss_mask_key``) do not count.

    Args:
        reduction: "mean", "sum", or "none" for one loss per sample; "mean" if None.
        weighted_terms: terms that the importance weights w multiply.
        weight_norm: "mean", as in TorchRL: the mean of losses l is sum(w l) / sum(w), and their sum
            is sum(w l). "max" differs from TorchRL: the weights are divided by the batch's largest
            (Schaul et al., 2016), so that the mean of N losses is sum(w l) / (N max w), which falls
            as the priorities spread.
        use_prioritized_weights: False ignores the weights in the batch; "auto" and True use them if
            there are any, as in TorchRL.
    """

    @dataclass
    class _AcceptedKeys:
        """Entries that ``set_keys`` can rename; entries of the next state are nested in "next"."""

        action: NestedKey = keys.ACTION
        reward: NestedKey = keys.REWARD
        done: NestedKey = keys.DONE
        terminated: NestedKey = keys.TERMINATED
        is_demonstration: NestedKey = keys.IS_DEMONSTRATION
        value: NestedKey = "state_value"
        priority: NestedKey = keys.TD_ERROR
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0

    def __init__(
        self,
        reduction: Reduction | None = None,
        *,
        weighted_terms: WeightedTerms = "critic_and_policy",
        weight_norm: WeightNorm = "mean",
        use_prioritized_weights: bool | Literal["auto"] = "auto",
    ) -> None:
        super().__init__()
        check_choice("weighted_terms", weighted_terms, WeightedTerms)
        check_choice("weight_norm", weight_norm, WeightNorm)
        self.weighted_terms: WeightedTerms = weighted_terms
        self.weight_norm: WeightNorm = weight_norm
        self.use_prioritized_weights = use_prioritized_weights
        self.reduction = checked_reduction(reduction)
        self._needed_keys: list[NestedKey] | None = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries that ``forward`` needs, in the order of its arguments if called with tensors."""
        if self._needed_keys is None:
            self._needed_keys = self._required_keys()
        return self._needed_keys

    @in_keys.setter
    def in_keys(self, values: Sequence[NestedKey]) -> None:
        self._needed_keys = list(values)

    @abstractmethod
    def _required_keys(self) -> list[NestedKey]:
        """Return the entries that ``forward`` needs, for `in_keys`."""

    def make_value_estimator(
        self, value_type: ValueEstimators | None = None, **hyperparams: object
    ) -> Self:
        """Set the estimator of targets; the default is TD(0) with gamma 0.99.

        Args:
            value_type: TD0, the only estimator for a batch of single transitions, or one of
                TorchRL's estimator objects.
            hyperparams: parameters of the estimator, such as ``gamma``.

        Raises:
            NotImplementedError: another of TorchRL's named estimators.
        """
        value_type = self.default_value_estimator if value_type is None else value_type
        if not isinstance(value_type, ValueEstimators):
            return super().make_value_estimator(value_type, **hyperparams)
        self.value_type = value_type
        names = ("value", "reward", "done", "terminated")
        dispatch_value_estimator(
            self,
            value_type,
            supported=(ValueEstimators.TD0,),
            tensor_keys={name: getattr(self.tensor_keys, name) for name in names},
            value_network=None,
            **{**default_value_kwargs(value_type), **hyperparams},
        )
        return self

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """Pass renamed keys to the value estimator and recompute `in_keys`."""
        super()._forward_value_estimator_keys(**kwargs)
        self._needed_keys = None

    def _transition_keys(self, observation: list[NestedKey]) -> list[NestedKey]:
        """Return the keys of a transition: observation, action, reward and done flags."""
        ends = (self.tensor_keys.reward, self.tensor_keys.done, self.tensor_keys.terminated)
        names = [self.tensor_keys.action, *observation, *map(next_key, (*observation, *ends))]
        return list(dict.fromkeys(names))

    def _missing(self, tensordict: TensorDictBase) -> list[NestedKey]:
        missing = super()._missing(tensordict)
        ends = [next_key(self.tensor_keys.done), next_key(self.tensor_keys.terminated)]
        # as in TorchRL, one of the two stands for the other
        return missing if set(ends) <= set(missing) else [key for key in missing if key not in ends]

    def _prepare(self, tensordict: TensorDictBase, key: NestedKey, own_dims: int) -> None:
        super()._prepare(tensordict, key, own_dims)
        names, shape = self.tensor_keys, tensordict.batch_size
        for name, dtype, *others in (
            (next_key(names.reward), None),
            (next_key(names.done), torch.bool),
            (next_key(names.terminated), torch.bool),
            (names.is_demonstration, torch.bool, shape),
            (names.priority_weight, None, shape),
        ):
            value = tensordict.get(name, None)
            if value is not None:
                self._require(name, value, dtype, [*shape, 1], *others)

    def _importance_weights(self, tensordict: TensorDictBase) -> dict[str, Tensor | None]:
        """Return the weights [...] of a term's samples, by the narrowest of `WeightedTerms` that
        includes the term; None if the term is not weighted."""
        weights = None
        if self.use_prioritized_weights:
            weights = tensordict.get(self.tensor_keys.priority_weight, None)
        if weights is not None:
            weights = weights.reshape(tensordict.batch_size)
            if self.weight_norm == "max":  # of the samples that a mask leaves, if there are any
                weights = self._reduce_loss(weights, tensordict, reduction="none")
                weights = weights / _positive(weights.amax())
        choices = get_args(WeightedTerms)
        last = choices.index(self.weighted_terms)
        return {term: weights if number <= last else None for number, term in enumerate(choices)}

    def _reduced(
        self,
        losses: Tensor,
        tensordict: TensorDictBase,
        weights: Tensor | None = None,
        chosen: Tensor | None = None,
        reduction: Reduction | None = None,
    ) -> Tensor:
        """Return the losses of samples, their mean or their sum, without those that are masked.

        Args:
            losses: of the samples, [...].
            tensordict: the batch, which may have a mask.
            weights: importance weights [...] from `_importance_weights`.
            chosen: bool [...]; the other samples have no loss and are left out of the mean, which
                is zero if there are none.
            reduction: None for the module's own.
        """
        reduction, counted = reduction or self.reduction, None
        if weights is not None and self.weight_norm == "max":
            losses, weights = weights * losses, None
        if chosen is not None:
            chosen = self._reduce_loss(chosen, tensordict, reduction="none")
            losses = torch.where(chosen, losses, 0.0)
            if reduction == "mean":
                counted = chosen | ~chosen.any()  # all zeros if there are none, not 0 / 0
        if weights is None or reduction != "mean":
            return self._reduce_loss(
                losses, tensordict, mask=counted, reduction=reduction, weights=weights
            )
        # as TorchRL's mean, which is 0 / 0 if every sample is masked or has no weight
        total, sum_of_weights = (
            self._reduce_loss(values, tensordict, mask=counted, reduction="sum", weights=factors)
            for values, factors in ((losses, weights), (weights, None))
        )
        return total / _positive(sum_of_weights)


def _positive(value: Tensor) -> Tensor:
    """Return a divisor that is not negative with the least positive number in place of 0."""
    return value.clamp_min(torch.finfo(value.dtype).tiny)


def next_key(key: NestedKey) -> tuple[str, ...]:
    """Return the key of an entry of the next state."""
    return (keys.NEXT, key) if isinstance(key, str) else (keys.NEXT, *key)
