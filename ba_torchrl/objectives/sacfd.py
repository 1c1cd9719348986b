"""Soft Actor-Critic from demonstrations, which includes plain SAC (appendix G.2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite
from torchrl.objectives import LossModule, SoftUpdate
from torchrl.objectives.sac import compute_rsample_log_prob
from typing_extensions import Self

from ba_torchrl.core import keys
from ba_torchrl.core.choices import ActionDistance
from ba_torchrl.core.errors import check_choice
from ba_torchrl.objectives.base import TransitionLoss
from ba_torchrl.objectives.distance import action_distance
from ba_torchrl.objectives.networks import check_network


class SACfDLoss(TransitionLoss):
    """Soft Actor-Critic with a behaviour term on the demonstrations in the batch (appendix G.2).

    With twin values q_1 and q_2 of the stored action, an action a ~ pi drawn from the policy, and
    importance weights u_i, v_i, w_i::

        y_i         = r_i + gamma (1 - terminated_i) (min_k q'_k(s'_i, a') - alpha log pi(a'|s'_i))
        loss_qvalue = sum_k mean_i u_i (q_k(s_i, a_i) - y_i)^2
        loss_actor  = mean_i v_i (alpha log pi(a | s_i) - min_k q_k(s_i, a)) + demonstration_weight
                      * mean over demonstrations of w_i d(a, e_i)
        loss_alpha  = mean_i -w_i log_alpha (log pi(a | s_i) + target_entropy)

    e_i is the expert's action in s_i: a_i, unless ``set_keys(target_action=...)`` names another
    entry. d(a, e_i) is the mean over components of (a - e_i)^2, or another `action_distance`.
    Without ``entropy_backup``, y_i has no term in alpha (Ball et al., 2023).

    u is the batch's normalised weights (``weight_norm``) unless ``weighted_terms`` is "none"; v for
    "critic_and_policy" and "all"; w for "all". Otherwise, and without prioritised replay, they are
    ones. Samples that a mask excludes are in no mean.

    With several views of an observation, every term of a sample is the mean over its views, and y
    over the views of the next observation (DrQ: Kostrikov et al., 2021, equation 3).

    The three are computed with the current parameters and have gradients with respect to disjoint
    parameters, so one backward pass on the sum of all losses suffices. The encoder is trained by
    loss_qvalue only; loss_actor uses its detached features. The target bootstraps on truncated
    steps and not on terminated ones.

    `contrastive_loss` trains the encoder with another loss, for optimisers of its own.

    ``forward`` also writes the priority, ``mean_k |q_k - y|`` of shape [..., 1], into its input.

    Args:
        actor_network: policy; from the observation to a distribution with ``rsample``.
        encoder_network: from the observation to a single entry, the critics' shared features.
        qvalue_network: from features and action to twin values [..., 2].
        alpha_init: initial entropy temperature.
        target_entropy: entropy that the temperature is tuned for, nats. With "auto", as in TorchRL,
            it is minus the number of the action's components, which is taken from the actor's spec
            or, without one, from the first batch; it is nan until then.
        entropy_backup: whether y has the entropy term; without it, y is the return alone.
        demonstration_weight: weight of the behaviour term; 0 for plain SAC, which needs no flag of
            demonstrations in the batch.
        demonstration_distance: of the behaviour term, "mse" or "kl", see
            `ba_torchrl.objectives.distance.action_distance`.
        views: number of views of the observation. If there are several, the entries of the
            observation have a dimension of views after the batch.
        target_views: number of views of the next observation, likewise.
        contrastive: of `contrastive_loss`: from anchors and positives [B, F] to losses [B].
        options: ``reduction``, ``weighted_terms``, ``weight_norm`` and ``use_prioritized_weights``
            of `ba_torchrl.objectives.base.TransitionLoss`; the formulas above are for the reduction
            "mean".

    Raises:
        ValueError: ``alpha_init`` is not positive, ``demonstration_distance`` is unknown, or the
            encoder has several outputs.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import NormalParamExtractor, TensorDictModule
        >>> from torchrl.modules import MLP, ProbabilisticActor, TanhNormal
        >>> from ba_torchrl.objectives import SACfDLoss
        >>> actor = torch.nn.Sequential(torch.nn.Linear(3, 4), NormalParamExtractor())
        >>> actor = TensorDictModule(actor, ["observation"], ["loc", "scale"])
        >>> actor = ProbabilisticActor(actor, ["loc", "scale"], distribution_class=TanhNormal)
        >>> encoder = TensorDictModule(torch.nn.Linear(3, 8), ["observation"], ["features"])
        >>> critics = MLP(in_features=8 + 2, out_features=2, num_cells=[16])
        >>> critics = TensorDictModule(critics, ["features", "action"], ["state_action_value"])
        >>> loss = SACfDLoss(actor, encoder, critics)
        >>> batch = {"observation": torch.rand(16, 3), "action": torch.rand(16, 2)}
        >>> ends = torch.zeros(16, 1, dtype=torch.bool)
        >>> batch["next"] = {"observation": torch.rand(16, 3), "reward": torch.rand(16, 1)}
        >>> batch["next"] |= {"done": ends, "terminated": ends}
        >>> batch["is_demonstration"] = torch.arange(16)[:, None] < 8
        >>> losses = loss(TensorDict(batch, [16]))
        >>> (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
        >>> loss.target_entropy
        tensor(-2.)
    """

    @dataclass
    class _AcceptedKeys(TransitionLoss._AcceptedKeys):
        """As for `TransitionLoss`, with the expert's action and the critics' values."""

        target_action: NestedKey | None = None
        state_action_value: NestedKey = "state_action_value"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _schedulable_buffers = frozenset({"target_entropy", "demonstration_weight"})

    actor_network: ProbabilisticTensorDictSequential
    encoder_network: TensorDictModule
    qvalue_network: TensorDictModule
    actor_network_params: TensorDictParams
    encoder_network_params: TensorDictParams
    qvalue_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    target_encoder_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams

    _without_flag = "; for plain SAC set demonstration_weight=0"

    out_keys = (
        "loss_actor",
        "loss_qvalue",
        "loss_alpha",
        "alpha",
        "entropy",
        "demonstration_error",
        "q_value",
    )

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        encoder_network: TensorDictModule,
        qvalue_network: TensorDictModule,
        *,
        alpha_init: float = 0.01,
        target_entropy: float | Literal["auto"] = "auto",
        entropy_backup: bool = True,
        demonstration_weight: float = 1.0,
        demonstration_distance: ActionDistance = "mse",
        views: int = 1,
        target_views: int = 1,
        contrastive: nn.Module | None = None,
        **options: Any,
    ) -> None:
        if alpha_init <= 0:
            raise ValueError(f"alpha_init must be positive, got {alpha_init}")
        check_choice("demonstration_distance", demonstration_distance, ActionDistance)
        check_network("actor_network", actor_network, "get_dist")
        check_network("encoder_network", encoder_network, "out_keys")
        check_network("qvalue_network", qvalue_network, "out_keys")
        if len(encoder_network.out_keys) != 1:
            raise ValueError(
                f"encoder_network must write one entry, got {encoder_network.out_keys}"
            )
        super().__init__(**options)
        self.convert_to_functional(actor_network, "actor_network")
        self.convert_to_functional(encoder_network, "encoder_network", create_target_params=True)
        self.convert_to_functional(qvalue_network, "qvalue_network", create_target_params=True)
        encoder = {id(p): key for key, p in self.encoder_network_params.items(True, True)}
        actor = self.actor_network_params.items(True, True)
        self._shared = {key: encoder[id(p)] for key, p in actor if id(p) in encoder}
        """Keys of the parameters that the actor shares with the encoder, in both networks."""
        self._share_encoder()
        device = next(self.parameters()).device
        if target_entropy == "auto":
            target_entropy = _entropy_of_spec(actor_network)
        self.register_coeff_buffer("target_entropy", float(target_entropy), device=device)
        self.target_entropy = float(target_entropy)  # for `__setattr__`
        self.register_coeff_buffer(
            "demonstration_weight", float(demonstration_weight), device=device
        )
        self.demonstration_weight = demonstration_weight  # for `__setattr__`
        self.log_alpha = nn.Parameter(torch.tensor(math.log(alpha_init), device=device))
        self.demonstration_distance: ActionDistance = demonstration_distance
        self.entropy_backup = entropy_backup
        self.views = views
        self.target_views = target_views
        self.contrastive = None if contrastive is None else contrastive.to(device)
        # Made before the first forward pass, because its gamma is part of the state_dict.
        self.make_value_estimator(device=device)
        self.register_load_state_dict_post_hook(_reread_coefficients)

    def _share_encoder(self) -> None:
        """Make shared parameters constants in the actor's terms, in the memory of the encoder's, so
        that the critics alone train them."""
        for key, of_encoder in self._shared.items():
            self.actor_network_params.set(key, self.encoder_network_params.get(of_encoder).data)

    def _apply(self, fn: Callable[[Tensor], Tensor]) -> Self:
        """Convert or move all tensors; the actor keeps sharing the encoder's."""
        super()._apply(fn)
        self._share_encoder()
        return self

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy or a pickled loss, whose actor shares the encoder's parameters."""
        super().__setstate__(state)
        self._share_encoder()

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute; a behaviour weight other than 0 needs the flag of demonstrations, and
        a target entropy of nan the size of an action."""
        super().__setattr__(name, value)
        if name == "target_entropy":
            self._needs_action_size = bool(value != value)
        if name == "demonstration_weight":
            self._needs_demonstration_flag = bool(value != 0)
            self._needed_keys = None

    @property
    def alpha(self) -> Tensor:
        """The entropy temperature, without gradient."""
        return self.log_alpha.detach().exp()

    @property
    def _target_key(self) -> NestedKey:
        names = self.tensor_keys
        return names.action if names.target_action is None else names.target_action

    def _required_keys(self) -> list[NestedKey]:
        observation = [*self.actor_network.in_keys, *self.encoder_network.in_keys]
        names = [*self._transition_keys(observation), self._target_key]
        if self._needs_demonstration_flag:
            names.append(self.tensor_keys.is_demonstration)
        return list(dict.fromkeys(names))

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses and detached diagnostics of a batch of transitions.

        Args:
            tensordict: transitions [...]; gets the priority written into it.

        Returns:
            ``loss_actor``, ``loss_qvalue`` and ``loss_alpha``, scalars or, with the reduction
            "none", of shape [...]; and without gradient the scalars ``alpha``, ``entropy``,
            ``demonstration_error`` (the unweighted behaviour term) and ``q_value`` (mean of the
            twin values of the stored actions).

        Raises:
            BatchError: an entry is missing, such as the flag of demonstrations if the behaviour
                term has a weight, or has another type or shape.
        """
        self._prepare(tensordict, self.tensor_keys.action, 1)
        weights = self._importance_weights(tensordict)
        state = self._observation(tensordict, self.views)
        features = self._features(state, self.encoder_network_params)
        loss_qvalue, values = self._critic_terms(tensordict, features, weights)

        sample, log_prob = self._sample_action(state)
        if self._needs_action_size:
            self.target_entropy = -float(sample.shape[-1])
        # Detached features and heads: the gradient reaches the actor's parameters only, through the
        # action.
        q_pi = self._values(features.detach(), sample, self.qvalue_network_params.detach())
        policy_term = self._over_views(self.alpha * log_prob - self._policy_value(q_pi))
        is_demonstration = self._demonstration_flag(tensordict)
        error = self._demonstration_error(tensordict, sample)
        demonstration = self._reduced(error, tensordict, weights["all"], is_demonstration)
        policy_term = self._reduced(policy_term, tensordict, weights["critic_and_policy"])
        loss_actor = policy_term + self.demonstration_weight * demonstration
        log_prob = self._over_views(log_prob.detach())
        temperature_term = self.log_alpha * (log_prob + self.target_entropy)
        loss_alpha = -self._reduced(temperature_term, tensordict, weights["all"])
        return TensorDict(
            {
                "loss_actor": loss_actor,
                "loss_qvalue": loss_qvalue,
                "loss_alpha": loss_alpha,
                "alpha": self.alpha,
                "entropy": -self._reduced(log_prob, tensordict, reduction="mean"),
                "demonstration_error": self._reduced(
                    error.detach(), tensordict, chosen=is_demonstration, reduction="mean"
                ),
                **values,
            }
        )

    def _critic_terms(
        self, tensordict: TensorDictBase, features: Tensor, weights: dict[str, Tensor | None]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the critics' loss and the diagnostics of their values; write the priority."""
        target = self._for_views(self._target(tensordict))
        action = self._for_views(tensordict[self.tensor_keys.action])
        q = self._values(features, action, self.qvalue_network_params)
        error = q - target
        priority = self._over_views(error.detach().abs().mean(dim=-1))
        tensordict.set(self.tensor_keys.priority, priority.unsqueeze(-1))
        squared = self._over_views(error.square().sum(dim=-1))
        loss = self._reduced(squared, tensordict, weights["critic"])
        return loss, {
            name: self._reduced(value, tensordict, reduction="mean")
            for name, value in self._diagnostics(q.detach()).items()
        }

    def _diagnostics(self, q: Tensor) -> dict[str, Tensor]:
        """Return statistics, of any shape, of the values [..., K] of the stored actions."""
        return {"q_value": q}

    def _target_value(self, q: Tensor) -> Tensor:
        """Return the value [...] of the target critics' values [..., K]."""
        return q.amin(dim=-1)

    def _policy_value(self, q: Tensor) -> Tensor:
        """Return the value [...] that the policy maximises, of the critics' values [..., K]."""
        return q.amin(dim=-1)

    def contrastive_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Return ``loss_contrastive``, the contrastive loss of the encoder.

        The encoder's features are anchors. The target encoder's features, of another view of the
        same observations, are positives (CURL: Srinivas et al., 2020; FERM: Zhan et al., 2020).

        Args:
            tensordict: observations [B]; only the first of several views is used, and
                other views of them under "positive".

        Raises:
            ValueError: the batch has another number of dimensions than one.
        """
        if tensordict.ndim != 1:
            shape = list(tensordict.batch_size)
            raise ValueError(f"contrastive_loss compares the samples of a batch [B], got {shape}")
        state = self._observation(tensordict, self.views)
        anchors = self._features(
            state[:, 0] if self.views > 1 else state, self.encoder_network_params
        )
        with torch.no_grad():
            other = tensordict.get(keys.POSITIVE)
            positives = self._features(other, self.target_encoder_network_params)
        losses = self.contrastive(anchors, positives)
        return TensorDict({"loss_contrastive": self._reduced(losses, tensordict)})

    @torch.no_grad()
    def _target(self, tensordict: TensorDictBase) -> Tensor:
        """Return the critics' target y, [..., 1]."""
        following = self._observation(tensordict.get(keys.NEXT), self.target_views)
        action, log_prob = self._sample_action(following)
        stored = tensordict[self.tensor_keys.action]
        dtype = action.dtype if stored.dtype == torch.float64 else None
        shape = stored.shape[:-1] + action.shape[-1:]
        self._require(self.tensor_keys.action, stored, dtype, shape)
        features = self._features(following, self.target_encoder_network_params)
        q = self._values(features, action, self.target_qvalue_network_params)
        value = self._target_value(q)
        if self.entropy_backup:
            value = value - self.alpha * log_prob
        if self.target_views > 1:
            value = value.mean(dim=-1)
        return self.value_estimator.value_estimate(tensordict, next_value=value.unsqueeze(-1))

    def _sample_action(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return an action [..., A] drawn with gradient and its log-probability [...]."""
        actor = self.network("actor_network")
        with self.actor_network_params.to_module(actor, preserve_module_state=False):
            observation = tensordict.select(*actor.in_keys)
            return compute_rsample_log_prob(actor.get_dist(observation))

    def _features(self, tensordict: TensorDictBase, params: TensorDictBase) -> Tensor:
        encoder = self.network("encoder_network")
        with params.to_module(encoder, preserve_module_state=False):
            observation = tensordict.select(*encoder.in_keys)
            return encoder(observation)[encoder.out_keys[0]]

    def _values(self, features: Tensor, action: Tensor, params: TensorDictBase) -> Tensor:
        """Return the values [..., K] of an action at given features."""
        inputs = TensorDict(
            {self.encoder_network.out_keys[0]: features, self.tensor_keys.action: action},
            batch_size=action.shape[:-1],
        )
        critic = self.network("qvalue_network")
        with params.to_module(critic, preserve_module_state=False):
            return critic(inputs)[self.tensor_keys.state_action_value]

    def _observation(self, tensordict: TensorDictBase, views: int) -> TensorDictBase:
        """Return the observation [..., B], or [..., B, views] if it has several views."""
        names = [*self.actor_network.in_keys, *self.encoder_network.in_keys]
        seen = tensordict.select(*dict.fromkeys(names))
        if views > 1:
            seen.batch_size = torch.Size([*tensordict.batch_size, views])
        return seen

    def _for_views(self, values: Tensor) -> Tensor:
        """Return values [..., B, D] of samples as values of their views [..., B, views, D]."""
        if self.views == 1:
            return values
        return values.unsqueeze(-2).expand(*values.shape[:-1], self.views, values.shape[-1])

    def _over_views(self, losses: Tensor) -> Tensor:
        """Return the losses of samples [..., B], means over their views' losses."""
        return losses.mean(dim=-1) if self.views > 1 else losses

    def _demonstration_error(self, tensordict: TensorDictBase, sample: Tensor) -> Tensor:
        """Return the distance [..., B] of drawn actions from the expert's."""
        target_action = self._for_views(tensordict[self._target_key])
        distance = action_distance(sample, target_action, self.demonstration_distance)
        return self._over_views(distance)

    def _demonstration_flag(self, tensordict: TensorDictBase) -> Tensor:
        """Return the flag of demonstrations, bool [..., B]; without a behaviour term, False if it
        is absent."""
        flag = tensordict.get(self.tensor_keys.is_demonstration, None)
        if flag is not None:
            return flag.reshape(tensordict.batch_size)
        action = tensordict[self.tensor_keys.action]
        return torch.zeros(tensordict.batch_size, dtype=torch.bool, device=action.device)


def _entropy_of_spec(actor: ProbabilisticTensorDictSequential) -> float:
    """Return minus the number of components in the spec of an actor's action; nan without one."""
    spec = getattr(actor, "spec", None)
    if isinstance(spec, Composite):
        spec = spec.get(actor.dist_sample_keys[0], None)
    return math.nan if spec is None else -float(spec.shape[-1])


class BilinearInfoNCE(nn.Module):
    """InfoNCE with a learnt bilinear similarity (CURL: Srinivas et al., 2020, section 4;
    FERM, appendix G.2).

    The similarity of anchor i and positive j is a_i W p_j. The loss of anchor i is the
    cross-entropy of these similarities over all positives of the batch with the label i.

    Args:
        features: size of the encoder's features of an image. Vectors that follow them are not
            compared: they tell an anchor's positive without the image.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(features, features))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw the weights of the similarity from [0, 1)."""
        nn.init.uniform_(self.weight)

    def forward(self, anchors: Tensor, positives: Tensor) -> Tensor:
        """Return the losses [B] of anchors [B, F] and their positives [B, F]."""
        anchors, positives = (each[:, : len(self.weight)] for each in (anchors, positives))
        similarities = anchors @ self.weight @ positives.mT
        labels = torch.arange(len(anchors), device=anchors.device)
        return F.cross_entropy(similarities, labels, reduction="none")


def _reread_coefficients(loss: SACfDLoss, _: object) -> None:
    """Let a restored loss need of a batch what its saved coefficients say."""
    loss.demonstration_weight = float(loss.demonstration_weight)
    loss.target_entropy = float(loss.target_entropy)


class SoftUpdateByNetwork(SoftUpdate):
    """TorchRL's soft update, in which some networks have other rates.

    Args:
        loss_module: with target networks.
        tau: weight of the online parameters.
        taus: other weights, by the name of the network in the loss, such as "encoder_network".
    """

    def __init__(self, loss_module: LossModule, *, tau: float, taus: Mapping[str, float]) -> None:
        super().__init__(loss_module, tau=tau)
        self.tau = tau
        self.taus = {f"{name}_params": value for name, value in taus.items()}

    def step(self) -> None:
        """Move every target towards its online network."""
        for name, source in self._sources.items():
            target = self._targets.get(f"target_{name}")
            target.data.lerp_(source.data, self.taus.get(name, self.tau))
