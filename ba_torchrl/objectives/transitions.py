"""What the losses on batches of single transitions share."""

from __future__ import annotations

from typing import Self

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator

from ba_torchrl.envs import keys


class TransitionLoss(LossModule):
    """A loss module whose targets reach one step ahead, and whose samples may bear weights."""

    default_value_estimator = ValueEstimators.TD0

    def make_value_estimator(
        self, value_type: ValueEstimators | None = None, **hyperparams: object
    ) -> Self:
        """Choose how targets are formed; TD(0) with gamma 0.99 unless called.

        Args:
            value_type: TD0, the one estimator that fits a batch of single transitions, or one of
                TorchRL's estimator objects.
            hyperparams: its parameters, such as ``gamma``.

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
        if self._value_estimator is not None:
            self._value_estimator.set_keys(**self._value_estimator_keys())

    def _value_estimator_keys(self) -> dict[str, NestedKey]:
        return {
            name: getattr(self.tensor_keys, name)
            for name in ("value", "reward", "done", "terminated")
        }

    def _transition_keys(self, observation: list[NestedKey]) -> list[NestedKey]:
        """Return the entries of a transition with this observation, action and ends included."""
        ends = (self.tensor_keys.reward, self.tensor_keys.done, self.tensor_keys.terminated)
        names = [self.tensor_keys.action, *observation, *map(_next, (*observation, *ends))]
        return list(dict.fromkeys(names))

    def _importance_weights(self, tensordict: TensorDictBase) -> Tensor | None:
        """Return the batch's importance weights [...] divided by their largest, None if absent."""
        weights = tensordict.get(self.tensor_keys.priority_weight, None)
        if weights is None:
            return None
        weights = weights.reshape(tensordict.batch_size)
        return weights / weights.amax()


def _next(key: NestedKey) -> tuple[str, ...]:
    return (keys.NEXT, key) if isinstance(key, str) else (keys.NEXT, *key)
