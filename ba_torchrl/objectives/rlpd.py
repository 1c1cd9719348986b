"""Soft Actor-Critic with an ensemble of critics (Ball et al., 2023; "RLPD")."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from torch import Tensor

from ba_torchrl.core.generators import seeded_generator
from ba_torchrl.objectives.sacfd import SACfDLoss


class RLPDLoss(SACfDLoss):
    """RLPD: `SACfDLoss` with K critics, whose targets are the least of a random subset.

    With a random subset M of the target critics, drawn in each call for the whole batch, two terms
    differ from `SACfDLoss`::

        y_i        = r_i + gamma (1 - terminated_i) (min_{k in M} q'_k(s'_i, a') - h_i)
        loss_actor = mean_i (alpha log pi(a | s_i) - mean_k q_k(s_i, a))

    h_i is ``alpha log pi(a'|s'_i)``, or 0 without entropy backup. TorchRL's ``REDQLoss`` has the
    same terms for critics that are whole networks, each with an encoder of its own.

    Args:
        actor_network: policy; from the observation to a distribution with ``rsample``.
        encoder_network: from the observation to a single entry, the critics' shared features.
        qvalue_network: from features and action to the values [..., K].
        subset: number of target critics in the minimum.
        seed: of the draws of the subset.
        entropy_backup: whether the target has the entropy term.
        demonstration_weight: weight of the behaviour term, which RLPD does not have.
        options: of `SACfDLoss`.

    Raises:
        ValueError: the subset is empty, or as for `SACfDLoss`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import NormalParamExtractor, TensorDictModule
        >>> from torchrl.modules import MLP, ProbabilisticActor, TanhNormal
        >>> from ba_torchrl.objectives import RLPDLoss
        >>> actor = torch.nn.Sequential(torch.nn.Linear(3, 4), NormalParamExtractor())
        >>> actor = TensorDictModule(actor, ["observation"], ["loc", "scale"])
        >>> actor = ProbabilisticActor(actor, ["loc", "scale"], distribution_class=TanhNormal)
        >>> encoder = TensorDictModule(torch.nn.Linear(3, 8), ["observation"], ["features"])
        >>> critics = MLP(in_features=8 + 2, out_features=10, num_cells=[16])
        >>> critics = TensorDictModule(critics, ["features", "action"], ["state_action_value"])
        >>> loss = RLPDLoss(actor, encoder, critics, subset=2)
        >>> batch = {"observation": torch.rand(16, 3), "action": torch.rand(16, 2)}
        >>> ends = torch.zeros(16, 1, dtype=torch.bool)
        >>> batch["next"] = {"observation": torch.rand(16, 3), "reward": torch.rand(16, 1)}
        >>> batch["next"] |= {"done": ends, "terminated": ends}
        >>> losses = loss(TensorDict(batch, [16]))
        >>> losses["loss_qvalue"].shape, losses["q_std"].shape
        (torch.Size([]), torch.Size([]))
    """

    out_keys = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy", "q_value", "q_std")

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        encoder_network: TensorDictModule,
        qvalue_network: TensorDictModule,
        *,
        subset: int = 2,
        seed: int = 0,
        entropy_backup: bool = False,
        demonstration_weight: float = 0.0,
        **options: Any,
    ) -> None:
        if subset < 1:
            raise ValueError(f"subset must be at least 1, got {subset}")
        super().__init__(
            actor_network,
            encoder_network,
            qvalue_network,
            entropy_backup=entropy_backup,
            demonstration_weight=demonstration_weight,
            **options,
        )
        self.subset = subset
        # On the CPU, so that the subsets of a seed are the same on all devices.
        self.generator = seeded_generator(seed)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return super().forward(tensordict).select(*self.out_keys)

    def critic_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Return ``loss_qvalue`` of transitions [...] and its diagnostics only."""
        features = self._features(
            self._observation(tensordict, self.views), self.encoder_network_params
        )
        weights = self._importance_weights(tensordict)
        loss, values = self._critic_terms(tensordict, features, weights)
        return TensorDict({"loss_qvalue": loss, **values})

    def _diagnostics(self, q: Tensor) -> dict[str, Tensor]:
        return {"q_value": q, "q_std": q.std(dim=-1)}

    def _target_value(self, q: Tensor) -> Tensor:
        chosen = torch.randperm(q.shape[-1], generator=self.generator, device="cpu")[: self.subset]
        return q[..., chosen.to(q.device)].amin(dim=-1)

    def _policy_value(self, q: Tensor) -> Tensor:
        return q.mean(dim=-1)
