"""Soft Actor-Critic with an ensemble of critics (Ball et al., 2023; "RLPD")."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn

from ba_torchrl.envs import keys
from ba_torchrl.objectives.base import TransitionLoss
from ba_torchrl.objectives.shared_encoder import SharedEncoderCritics


class RLPDLoss(SharedEncoderCritics, TransitionLoss):
    """Soft Actor-Critic with an ensemble of K critics on a shared encoder.

    With a random subset M of the target critics, drawn in each call for the whole batch, and
    actions a' ~ pi(s') and a ~ pi(s)::

        y_i         = r_i + gamma (1 - terminated_i) (min_{k in M} q'_k(s'_i, a') - h_i)
        h_i         = alpha log pi(a'|s'_i), or 0 without entropy backup
        loss_qvalue = mean_i sum_k (q_k(s_i, a_i) - y_i)^2
        loss_actor  = mean_i (alpha log pi(a | s_i) - mean_k q_k(s_i, a))
        loss_alpha  = mean_i -log_alpha (log pi(a | s_i) + target_entropy)

    The target bootstraps on truncated steps and not on terminated ones. The encoder is trained by
    loss_qvalue only. TorchRL's ``REDQLoss`` has the same terms for critics that are whole networks,
    each with an encoder of its own, under ``vmap``, which steerable convolutions do not support.

    Args:
        actor_network: policy; from the observation to a distribution with ``rsample``.
        encoder_network: from the observation to a single entry, the critics' shared features.
        qvalue_network: from features and action to the values [..., K].
        subset: number of target critics in the minimum.
        entropy_backup: whether the target has the entropy term.
        alpha_init: initial entropy temperature.
        target_entropy: entropy that the temperature is tuned for, nats.
        seed: of the draws of the subset.
    """

    @dataclass
    class _AcceptedKeys:
        """Entries that ``set_keys`` can rename; those of the next state are nested in "next"."""

        action: NestedKey = keys.ACTION
        reward: NestedKey = keys.REWARD
        done: NestedKey = keys.DONE
        terminated: NestedKey = keys.TERMINATED
        state_action_value: NestedKey = "state_action_value"
        value: NestedKey = "state_value"
        priority: NestedKey = keys.TD_ERROR
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    actor_network: ProbabilisticTensorDictSequential
    encoder_network: TensorDictModule
    qvalue_network: TensorDictModule
    actor_network_params: TensorDictParams
    encoder_network_params: TensorDictParams
    qvalue_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    target_encoder_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams

    out_keys = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy", "q_value", "q_std")

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        encoder_network: TensorDictModule,
        qvalue_network: TensorDictModule,
        *,
        subset: int = 2,
        entropy_backup: bool = False,
        alpha_init: float = 0.01,
        target_entropy: float = -5.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self._convert_networks(actor_network, encoder_network, qvalue_network)
        self.subset = subset
        self.entropy_backup = entropy_backup
        self.target_entropy = target_entropy
        self.log_alpha = nn.Parameter(
            torch.tensor(math.log(alpha_init), device=self._default_device)
        )
        # On the CPU, so that the subsets of a seed are the same on all devices.
        self._generator = torch.Generator().manual_seed(seed)
        # Made before the first forward pass, because its gamma is part of the state_dict.
        self.make_value_estimator(device=self._default_device)

    @property
    def alpha(self) -> Tensor:
        """The entropy temperature, without gradient."""
        return self.log_alpha.detach().exp()

    def _required_keys(self) -> list[NestedKey]:
        return self._transition_keys([*self.actor_network.in_keys, *self.encoder_network.in_keys])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``loss_actor``, ``loss_qvalue``, ``loss_alpha`` and detached diagnostics.

        Args:
            tensordict: transitions [B].
        """
        features = self._features(tensordict, self.encoder_network_params)
        return self._critic_terms(tensordict, features).update(
            self._actor_terms(tensordict, features.detach())
        )

    def critic_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Return ``loss_qvalue`` and its diagnostics only.

        Args:
            tensordict: transitions [B].
        """
        features = self._features(tensordict, self.encoder_network_params)
        return self._critic_terms(tensordict, features)

    def _critic_terms(self, tensordict: TensorDictBase, features: Tensor) -> TensorDict:
        action = tensordict[self.tensor_keys.action]
        q = self._values(features, action, self.qvalue_network_params)
        loss = (q - self._target(tensordict)).square().sum(dim=-1).mean()
        q = q.detach()
        return TensorDict({"loss_qvalue": loss, "q_value": q.mean(), "q_std": q.std(dim=-1).mean()})

    def _actor_terms(self, tensordict: TensorDictBase, features: Tensor) -> TensorDict:
        sample, log_prob = self._sample_action(tensordict)
        # Detached heads: the gradient reaches the actor's parameters only, through the action.
        q = self._values(features, sample, self.qvalue_network_params.data).mean(dim=-1)
        loss_actor = (self.alpha * log_prob - q).mean()
        log_prob = log_prob.detach()
        return TensorDict(
            {
                "loss_actor": loss_actor,
                "loss_alpha": -(self.log_alpha * (log_prob + self.target_entropy)).mean(),
                "alpha": self.alpha,
                "entropy": -log_prob.mean(),
            }
        )

    @torch.no_grad()
    def _target(self, tensordict: TensorDictBase) -> Tensor:
        """Return the critics' target y, [B, 1]."""
        following = tensordict.get(keys.NEXT)
        action, log_prob = self._sample_action(following)
        features = self._features(following, self.target_encoder_network_params)
        q = self._values(features, action, self.target_qvalue_network_params)
        chosen = torch.randperm(q.shape[-1], generator=self._generator, device="cpu")[: self.subset]
        value = q[..., chosen.to(q.device)].amin(dim=-1, keepdim=True)
        if self.entropy_backup:
            value = value - self.alpha * log_prob.unsqueeze(-1)
        return self.value_estimator.value_estimate(tensordict, next_value=value)

    def get_generator_state(self) -> Tensor:
        """Return the state of the generator of subsets."""
        return self._generator.get_state()

    def set_generator_state(self, state: Tensor) -> None:
        """Restore the state of the generator, from any device."""
        self._generator.set_state(state.cpu())
