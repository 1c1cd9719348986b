"""Imitation of an expert's actions: behaviour cloning of Gaussian policies and of Q networks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import QValueActor
from torchrl.objectives.sac import compute_rsample_log_prob

from ba_torchrl.core import keys
from ba_torchrl.core.choices import ActionDistance
from ba_torchrl.core.errors import check_choice
from ba_torchrl.objectives.distance import action_distance
from ba_torchrl.objectives.dqn import LevelValues, as_levels
from ba_torchrl.objectives.networks import (
    EvalModeTargetsLoss,
    Reduction,
    check_network,
    checked_reduction,
)


class ImitationLoss(EvalModeTargetsLoss):
    """A loss on observations and the actions to imitate, reduced over the samples of a batch that
    no mask excludes (TorchRL's ``loss_mask_key``)."""

    @dataclass
    class _AcceptedKeys:
        """Entries that ``set_keys`` can rename."""

        action: NestedKey = keys.ACTION

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(self, reduction: Reduction | None) -> None:
        super().__init__()
        self.reduction = checked_reduction(reduction)

    def _set_observation(self, observation: Sequence[NestedKey]) -> None:
        self._observation = list(observation)
        self._forward_value_estimator_keys()

    def _forward_value_estimator_keys(self, **_: NestedKey) -> None:
        """Recompute `in_keys`; the loss has no value estimator."""
        self.in_keys = [*self._observation, *astuple(self.tensor_keys)]


class BehaviourCloningLoss(ImitationLoss):
    """Behaviour cloning of a stochastic policy: the distance of its sampled action to the expert's.

    The mean over the batch of the `action_distance` of a ~ pi, drawn with gradient, from the
    expert's action a_e, plus w log pi(a). With "mse", which is the behaviour term of SACfD
    (appendix G.2), the expectation of the distance is the squared error of the mean plus the
    variance, so it trains the standard deviation as well. Without the entropy term (w = 0) the
    standard deviation tends to zero. TorchRL's ``BCLoss`` has the likelihood instead, which a
    squashed Gaussian does not bound at the ends of the action's range, where the experts' gripper
    commands are, or the error of the mode.

    Args:
        actor_network: policy; from the observation to a distribution with ``rsample``.
        distance: of actions, "mse" or "kl", see `ba_torchrl.objectives.distance.action_distance`.
        entropy_weight: weight w of the negative entropy of the policy.
        reduction: "mean", "sum", or "none" for one loss per sample; "mean" if None.

    Examples:
        >>> import torch
        >>> from tensordict.nn import NormalParamExtractor, TensorDictModule
        >>> from torchrl.modules import ProbabilisticActor, TanhNormal
        >>> from ba_torchrl.objectives import BehaviourCloningLoss
        >>> actor = torch.nn.Sequential(torch.nn.Linear(3, 4), NormalParamExtractor())
        >>> actor = TensorDictModule(actor, ["observation"], ["loc", "scale"])
        >>> actor = ProbabilisticActor(actor, ["loc", "scale"], distribution_class=TanhNormal)
        >>> loss = BehaviourCloningLoss(actor, distance="kl", reduction="none")
        >>> loss(observation=torch.rand(8, 3), action=torch.rand(8, 2)).shape
        torch.Size([8])
    """

    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        distance: ActionDistance = "mse",
        entropy_weight: float = 0.0,
        reduction: Reduction | None = None,
    ) -> None:
        check_choice("distance", distance, ActionDistance)
        check_network("actor_network", actor_network, "get_dist")
        super().__init__(reduction)
        self.convert_to_functional(actor_network, "actor_network")
        self.distance: ActionDistance = distance
        self.entropy_weight = entropy_weight
        self.out_keys = ["loss_bc", "entropy"] if entropy_weight else ["loss_bc"]
        self._set_observation(actor_network.in_keys)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``loss_bc`` and, with the entropy term, its mean ``entropy`` without gradient.

        Args:
            tensordict: observations and expert actions [...]. The observation's entries may have a
                dimension of views after the batch.
        """
        self._prepare(tensordict, self.tensor_keys.action, 1)
        actor = self.network("actor_network")
        with self.actor_network_params.to_module(actor, preserve_module_state=False):
            distribution = actor.get_dist(tensordict.select(*actor.in_keys))
            if self.entropy_weight:
                sample, log_prob = compute_rsample_log_prob(distribution)
            else:
                sample = distribution.rsample()
        action = tensordict[self.tensor_keys.action]
        if sample.ndim > action.ndim:
            action = action.unsqueeze(-2).expand_as(sample)
        loss = self._over_samples(action_distance(sample, action, self.distance), tensordict)
        if not self.entropy_weight:
            return TensorDict({"loss_bc": loss})
        loss = loss + self.entropy_weight * self._over_samples(log_prob, tensordict)
        entropy = -self._reduce_loss(log_prob.detach(), tensordict, reduction="mean")
        return TensorDict({"loss_bc": loss, "entropy": entropy})

    def _over_samples(self, losses: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Return the reduction of losses [...], or of means over views of losses [..., views]."""
        if losses.ndim > tensordict.ndim and self.reduction != "mean":  # the same in any order
            losses = losses.mean(dim=-1)
        return self._reduce_loss(losses, tensordict)


class LevelCrossEntropyLoss(ImitationLoss):
    """Behaviour cloning of a policy that chooses an action level by level.

    The cross-entropy of the softmax of each level's values with the expert's choice, conditioned on
    the expert's choices at the levels before, averaged over the batch and summed over the levels.

    With sets of actions S any of which may be chosen, it is the negative logarithm of the summed
    probability of their choices C at each level::

        -log sum_{c in C} p(c) = logsumexp(q) - logsumexp(q restricted to C)

    A later level is conditioned on the choice in C that the policy prefers, and the actions of S
    without that choice do not count there. It is the likelihood of "the action is in S" (Jin and
    Ghahramani, 2002): zero as soon as all probability is in S, wherever that is. A target that is
    spread evenly over S would ask for equal probabilities within S, which no image determines.

    Args:
        value_network: computes the values of the levels, see
            `ba_torchrl.objectives.dqn.LevelValues`. TorchRL's `QValueActor` is used as a single
            level, see `SingleLevelValues`.
        reduction: "mean", "sum", or "none" for one loss per sample; "mean" if None.
        of_sets: whether the entry ``action`` has K actions of each sample, some of them perhaps
            repeated, in a dimension before the dimension of an action's components.

    Examples:
        >>> import torch
        >>> from torchrl.modules import QValueActor
        >>> from ba_torchrl.objectives import LevelCrossEntropyLoss
        >>> actor = QValueActor(torch.nn.Linear(3, 5), action_space="categorical")
        >>> loss = LevelCrossEntropyLoss(actor)
        >>> loss_bc, accuracy = loss(observation=torch.rand(8, 3), action=torch.randint(5, (8,)))
        >>> loss_bc.backward()
        >>> loss = LevelCrossEntropyLoss(actor, of_sets=True)
        >>> equal = torch.tensor([[0, 3]]).expand(8, 2)  # either will do
        >>> loss_bc, accuracy = loss(observation=torch.rand(8, 3), action=equal)
    """

    value_network: nn.Module
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    out_keys = ("loss_bc", "accuracy")

    def __init__(
        self,
        value_network: LevelValues | QValueActor,
        reduction: Reduction | None = None,
        *,
        of_sets: bool = False,
    ) -> None:
        super().__init__(reduction)
        self.of_sets = of_sets
        value_network = as_levels(value_network)
        self.convert_to_functional(value_network, "value_network")
        self._set_observation(value_network.in_keys)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``loss_bc`` of observations and expert actions [...], and the fraction of choices
        that are the expert's as ``accuracy``."""
        own_dims = self.value_network.action_dims + self.of_sets
        self._prepare(tensordict, self.tensor_keys.action, own_dims)
        if tensordict.ndim != 1:
            return self._of_one_dimension(tensordict)
        network = self.network("value_network")
        with self.value_network_params.to_module(network, preserve_module_state=False):
            values_of = network.of_moves if self.of_sets else network
            levels = values_of(*(tensordict[key] for key in self.in_keys))
        if self.of_sets:
            losses = [set_cross_entropy(*level) for level in levels]
            hits = [
                chosen.gather(1, values.argmax(dim=1, keepdim=True))[:, 0].float()
                for values, chosen in levels
            ]
        else:
            losses = [F.cross_entropy(*level, reduction="none") for level in levels]
            hits = [(values.argmax(dim=1) == chosen).float() for values, chosen in levels]
        losses = torch.stack([self._reduce_loss(each, tensordict) for each in losses])
        hits = [self._reduce_loss(each, tensordict, reduction="mean") for each in hits]
        return TensorDict({"loss_bc": losses.sum(dim=0), "accuracy": torch.stack(hits).mean()})


def set_cross_entropy(values: Tensor, chosen: Tensor) -> Tensor:
    """Return the negative logarithms of the summed probabilities of choices [B].

    Args:
        values: of all choices, whose softmax is the policy [B, N].
        chosen: which choices count, at least one of them, bool [B, N].
    """
    return values.logsumexp(dim=1) - values.masked_fill(~chosen, -math.inf).logsumexp(dim=1)
