"""The base class of losses on batches of single transitions."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator
from typing_extensions import Self

from ba_torchrl.envs import keys

Reduction = Literal["none", "mean", "sum"]
"""How the losses of a batch's samples are combined, as in TorchRL."""
WeightedTerms = Literal["none", "critic", "critic_and_policy", "all"]
"""Terms of a loss that importance weights multiply: the error of the values; also the policy's
objective; also the terms on demonstrations and the entropy temperature."""
WeightNorm = Literal["max", "mean"]
"""Statistic of a batch's importance weights by which they are divided."""


class TransitionLoss(LossModule):
    """A loss with one-step targets and optional importance weights of the samples.

    Args:
        reduction: "mean", "sum", or "none" for one loss per sample; "mean" if None.
        weighted_terms: terms that the importance weights multiply.
        weight_norm: statistic by which a batch's weights are divided. With "max", no weight
            exceeds one and their mean falls as the priorities spread; with "mean", their mean is
            one.
    """

    @dataclass
    class _AcceptedKeys:
        """Entries that ``set_keys`` can rename; those of the next state are nested in "next"."""

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
        weight_norm: WeightNorm = "max",
    ) -> None:
        super().__init__()
        if weighted_terms not in get_args(WeightedTerms) or weight_norm not in get_args(WeightNorm):
            raise ValueError(
                f"weighted_terms is one of {get_args(WeightedTerms)} and weight_norm one of "
                f"{get_args(WeightNorm)}, got {weighted_terms!r} and {weight_norm!r}"
            )
        self.weighted_terms: WeightedTerms = weighted_terms
        self.weight_norm: WeightNorm = weight_norm
        self.reduction: Reduction = "mean" if reduction is None else reduction
        if self.reduction not in ("none", "mean", "sum"):
            raise ValueError(f"reduction must be none, mean or sum, got {reduction!r}")
        self._in_keys: list[NestedKey] | None = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries that ``forward`` needs, in the order of its arguments if called with tensors."""
        if self._in_keys is None:
            self._in_keys = self._required_keys()
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: Sequence[NestedKey]) -> None:
        self._in_keys = list(values)

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
        value_type, settings = self._prepare_value_estimator_kwargs(value_type, **hyperparams)
        if value_type is not None:
            dispatch_value_estimator(
                self,
                value_type,
                supported=(ValueEstimators.TD0,),
                tensor_keys=self._value_estimator_keys(),
                value_network=None,
                **settings,
            )
        return self

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """Pass renamed keys to the value estimator and recompute `in_keys`."""
        if self._value_estimator is not None:
            self._value_estimator.set_keys(**self._value_estimator_keys())
        self._in_keys = None

    def _value_estimator_keys(self) -> dict[str, NestedKey]:
        return {
            name: getattr(self.tensor_keys, name)
            for name in ("value", "reward", "done", "terminated")
        }

    def _transition_keys(self, observation: list[NestedKey]) -> list[NestedKey]:
        """Return the keys of a transition: observation, action, reward and done flags."""
        ends = (self.tensor_keys.reward, self.tensor_keys.done, self.tensor_keys.terminated)
        names = [self.tensor_keys.action, *observation, *map(_next, (*observation, *ends))]
        return list(dict.fromkeys(names))

    def _importance_weights(self, tensordict: TensorDictBase) -> dict[str, Tensor | None]:
        """Return the weights [...] of a term's samples, divided by their largest or their mean, by
        the narrowest of `WeightedTerms` that includes the term; None if the term is not weighted.
        """
        weights = tensordict.get(self.tensor_keys.priority_weight, None)
        if weights is not None:
            weights = weights.reshape(tensordict.batch_size)
            weights = weights / (weights.amax() if self.weight_norm == "max" else weights.mean())
        choices = get_args(WeightedTerms)
        last = choices.index(self.weighted_terms)
        return {term: weights if number <= last else None for number, term in enumerate(choices)}


def weighted(losses: Tensor, weights: Tensor | None) -> Tensor:
    """Return the losses of samples [...] times their weights [...], if there are any."""
    return losses if weights is None else weights * losses


def reduce_loss(losses: Tensor, reduction: Reduction) -> Tensor:
    """Return the losses of samples, their mean or their sum.

    Args:
        losses: of the samples, of any shape.
        reduction: "none", "mean" or "sum".
    """
    if reduction == "none":
        return losses
    return losses.sum() if reduction == "sum" else losses.mean()


def reduce_over(losses: Tensor, chosen: Tensor, reduction: Reduction) -> Tensor:
    """Return the losses of the chosen samples, their mean or their sum; zero if there are none.

    Args:
        losses: of the samples, [...].
        chosen: bool [...]; the other samples are excluded from the mean and the sum.
        reduction: "none", "mean" or "sum"; "none" returns zeros for the other samples.
    """
    share = chosen.to(losses.dtype)
    if reduction == "mean":
        return (losses * share).sum() / share.sum().clamp_min(1)
    return reduce_loss(losses * share, reduction)


def _next(key: NestedKey) -> tuple[str, ...]:
    return (keys.NEXT, key) if isinstance(key, str) else (keys.NEXT, *key)
