"""TorchRL's loss of implicit Q-learning, with targets in evaluation mode."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from torchrl.objectives import IQLLoss

from ba_torchrl.objectives.networks import EvalModeTargetsLoss


class EvalModeTargetsIQLLoss(IQLLoss, EvalModeTargetsLoss):
    """TorchRL's ``IQLLoss``, whose networks are in training mode only in the terms that train them.

    Arguments and values are as in `torchrl.objectives.IQLLoss`.
    """

    qvalue_network_in_evaluation_mode: TensorDictModule
    target_actor_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    @property
    def actor_network(self) -> TensorDictModule:
        """The policy, in evaluation mode if gradients are disabled."""
        return self.network("actor_network")

    @property
    def value_network(self) -> TensorDictModule:
        """The state value, in evaluation mode if gradients are disabled."""
        return self.network("value_network")

    @torch.no_grad()
    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> None:
        """Set the estimator of targets, as in TorchRL; its network is in evaluation mode."""
        return super().make_value_estimator(value_type, **hyperparams)

    def _make_vmap(self) -> None:
        """Compute target values with the copy of the critics in evaluation mode."""
        super()._make_vmap()
        self._trained_values, network = self._vmap_qvalue_networkN0, self.qvalue_network
        self.__dict__["qvalue_network"] = self.qvalue_network_in_evaluation_mode
        super()._make_vmap()
        self._untrained_values = self._vmap_qvalue_networkN0
        self.__dict__["qvalue_network"] = network
        self._vmap_qvalue_networkN0 = self._values  # a method, which a copy of the loss has as well

    def _values(self, tensordict: TensorDictBase, params: TensorDictBase) -> TensorDictBase:
        """Return the observation and actions with the values of all critics, [critics, ...]."""
        is_trained = torch.is_grad_enabled() and params is self.qvalue_network_params
        compute = self._trained_values if is_trained else self._untrained_values
        return compute(tensordict, params)
