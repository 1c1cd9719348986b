"""Q-learning with actions chosen level by level, and demonstrations (appendix E, G.1)."""

from __future__ import annotations

from typing import Any, Literal, Protocol

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import QValueActor

from ba_torchrl.core import keys
from ba_torchrl.core.errors import BatchError, check_choice, layout
from ba_torchrl.objectives.base import TransitionLoss, next_key
from ba_torchrl.objectives.networks import check_network

Demonstrations = Literal["none", "dqfd", "sdqfd", "adet"]
"""The loss on demonstrated actions that is added to the TD loss."""


class LevelValues(Protocol):
    """A module that computes the values of the choices of an action, level by level."""

    in_keys: list[NestedKey]
    """Keys of the observation, in the order of the arguments."""
    action_dims: int
    """Number of dimensions of an action: 1 for a vector, 0 for an index."""

    def __call__(self, *observation_and_action: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the values [B, N] of each level and the index of the action's choice [B].

        The values of a level are conditioned on the action's choices at the levels before.
        """
        ...

    def of_moves(self, *observation_and_moves: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the values [B, N] of each level, and which choices lead to any of K actions,
        bool [B, N]; only losses of sets of actions ask.

        The values of a level, and the actions that count there, are those after the choice of the
        greatest value among the actions at each level before.
        """
        ...

    def greedy(self, *observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return the greedy choices [B, n], level by level, and the last level's value [B, 1]."""
        ...

    def value_of(self, *observation_and_choices: Tensor) -> Tensor:
        """Return the last level's value [B, 1] of choices [B, n]; only double Q-learning asks."""
        ...


class SingleLevelValues(nn.Module):
    """The action values of a TorchRL `QValueActor` as a single level of choices.

    Args:
        actor: with the action space "one_hot" or "categorical".

    Raises:
        ValueError: the actor has another action space.

    Examples:
        >>> import torch
        >>> from torchrl.modules import QValueActor
        >>> from ba_torchrl.objectives import SingleLevelValues
        >>> values = SingleLevelValues(QValueActor(torch.nn.Linear(3, 5), action_space="one_hot"))
        >>> choice, value = values.greedy(torch.rand(8, 3))
        >>> choice.shape, value.shape
        (torch.Size([8, 1]), torch.Size([8, 1]))
    """

    def __init__(self, actor: QValueActor) -> None:
        super().__init__()
        values, choice = actor[0], actor[1]
        if choice.action_space not in ("one_hot", "categorical"):
            raise ValueError(
                f"the action space must be one_hot or categorical, got {choice.action_space!r}"
            )
        self.values = values
        self.is_one_hot = choice.action_space == "one_hot"
        self.action_dims = int(self.is_one_hot)
        self.in_keys: list[NestedKey] = list(values.in_keys)
        self._value_key = choice.in_keys[0]

    def greedy(self, *observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return the choices [B, 1] of greatest value, and their values [B, 1]."""
        value, best = self._action_values(observation).max(dim=1, keepdim=True)
        return best, value

    def value_of(self, *observation_and_choices: Tensor) -> Tensor:
        """Return the values [B, 1] of choices [B, 1]."""
        *observation, chosen = observation_and_choices
        return self._action_values(observation).gather(1, chosen)

    def forward(self, *observation_and_action: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the values of all actions [B, N], and the index of the given action [B]."""
        *observation, action = observation_and_action
        values = self._action_values(observation)
        wanted = values.shape if self.is_one_hot else values.shape[:1]
        if action.shape != wanted and (self.is_one_hot or action.shape != (*wanted, 1)):
            kind = "one-hot" if self.is_one_hot else "categorical"
            raise BatchError(
                f"the actions are {layout(action.dtype, action.shape)}, and must be {list(wanted)} "
                f"in the QValueActor's action space, which is {kind}"
            )
        chosen = action.long().argmax(dim=-1) if self.is_one_hot else action.reshape(len(action))
        return [(values, chosen.long())]

    def of_moves(self, *observation_and_moves: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the values of all actions [B, N], and which are among some, bool [B, N]."""
        *observation, moves = observation_and_moves
        chosen = moves.long().argmax(dim=-1) if self.is_one_hot else moves.flatten(1).long()
        values = self._action_values(observation)
        return [(values, torch.zeros_like(values).scatter_(1, chosen, 1.0) > 0)]

    def _action_values(self, observation: list[Tensor] | tuple[Tensor, ...]) -> Tensor:
        data = TensorDict({}, [len(observation[0])])
        for key, value in zip(self.in_keys, observation, strict=True):
            data.set(key, value)
        return self.values(data)[self._value_key]


def as_levels(network: LevelValues | QValueActor) -> LevelValues:
    """Return a network of levels, which a `QValueActor` becomes as `SingleLevelValues`.

    Raises:
        ConfigError: the network is of another kind.
    """
    if isinstance(network, QValueActor):
        return SingleLevelValues(network)
    check_network("value_network", network, "action_dims")
    return network


def large_margin(q: Tensor, chosen: Tensor, margin: float) -> Tensor:
    """Return the margin losses of DQfD [B] (appendix E).

    max_a [Q(a) + margin * 1(a != a_e)] - Q(a_e).

    Args:
        q: values of all actions [B, N].
        chosen: the expert's action [B].
        margin: least difference of Q(a_e) to the other values.
    """
    of_chosen = q.gather(1, chosen[:, None])
    is_other = torch.ones_like(q).scatter_(1, chosen[:, None], 0.0)
    return (q + margin * is_other).amax(dim=1) - of_chosen[:, 0]


def strict_large_margin(q: Tensor, chosen: Tensor, margin: float) -> Tensor:
    """Return the margin losses of SDQfD [B], which have every violating action (appendix E).

    The mean of Q(a) - Q(a_e) + margin over {a != a_e: Q(a) > Q(a_e) - margin}, zero if that set is
    empty.

    Args:
        q: values of all actions [B, N].
        chosen: the expert's action [B].
        margin: least difference of Q(a_e) to the other values.
    """
    # The gap of the expert's action is the margin, which is taken out of sum and count.
    gap = q - q.gather(1, chosen[:, None]) + margin
    count = (gap.detach() > 0).sum(dim=1) - int(margin > 0)
    return (gap.relu().sum(dim=1) - margin) / count.clamp_min(1)


def cross_entropy(q: Tensor, chosen: Tensor, beta: float) -> Tensor:
    """Return the losses of ADET [B]: the cross-entropy of softmax(beta Q) with the expert's action.

    Args:
        q: values of all actions [B, N].
        chosen: the expert's action [B].
        beta: inverse temperature.
    """
    return F.cross_entropy(beta * q, chosen, reduction="none")


class LevelDQNLoss(TransitionLoss):
    """Deep Q-learning on levels of choices, with or without demonstrations (appendix G.1).

    At each level, the value of the stored action, conditioned on its choices at the levels before,
    is regressed to the same target: the last level's value of the choices that are greedy under the
    *target* network, level after level::

        y        = r + gamma (1 - terminated) Q'_last(s', a'_1, ..., a'_k)
        loss_qvalue        = sum over levels of the mean of w_i huber(Q_level(s_i, a_i) - y_i)
        loss_demonstration = weight * sum over levels of the chosen term on the experts' samples

    With ``double_dqn``, these choices are greedy under the online network (van Hasselt et al.,
    2016). The target bootstraps on truncated steps and not on terminated ones. ``forward`` also
    writes the priority, the mean of ``|Q_level - y|`` over the levels, of shape [..., 1], into its
    input.

    Args:
        value_network: computes the values of the levels, see `LevelValues`, such as
            `ba_torchrl.modules.SpatialValues`. TorchRL's `QValueActor` is used as a single level,
            see `SingleLevelValues`.
        demonstrations: "dqfd" `large_margin` and "adet" `cross_entropy`, means over the
            demonstrations in the batch; "sdqfd" `strict_large_margin`, a mean over the batch, with
            zero for other samples; or "none" for plain DQN, which needs no demonstration flag.
        demonstration_weight: weight of that term.
        margin: margin of "dqfd" and "sdqfd".
        first_beta: inverse temperature of "adet" at the first level.
        later_beta: inverse temperature of "adet" at later levels.
        double_dqn: whether the online network chooses the actions whose values the target network
            computes.
        options: ``reduction``, ``weighted_terms``, ``weight_norm`` and ``use_prioritized_weights``
            of `ba_torchrl.objectives.base.TransitionLoss`; the formulas above are for the reduction
            "mean".

    Raises:
        ValueError: ``demonstrations`` is unknown, or the margin is negative.

    Examples:
        >>> import torch
        >>> from torchrl.modules import QValueActor
        >>> from torchrl.objectives import HardUpdate
        >>> from ba_torchrl.objectives import LevelDQNLoss
        >>> actor = QValueActor(torch.nn.Linear(3, 5), action_space="categorical")
        >>> loss = LevelDQNLoss(actor, demonstrations="sdqfd", double_dqn=True)
        >>> loss = loss.make_value_estimator(gamma=0.95)
        >>> updater = HardUpdate(loss, value_network_update_interval=100)
        >>> ends, flag = torch.zeros(8, 1, dtype=torch.bool), torch.ones(8, 1, dtype=torch.bool)
        >>> losses = loss(
        ...     observation=torch.rand(8, 3), action=torch.randint(5, (8,)),
        ...     next_observation=torch.rand(8, 3), next_reward=torch.rand(8, 1),
        ...     next_done=ends, next_terminated=ends, is_demonstration=flag,
        ... )
        >>> loss.out_keys[:2]
        ['loss_qvalue', 'loss_demonstration']
        >>> (losses[0] + losses[1]).backward()
    """

    value_network: nn.Module
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    _without_flag = "; for plain DQN set demonstrations='none'"

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
        double_dqn: bool = False,
        **options: Any,
    ) -> None:
        check_choice("demonstrations", demonstrations, Demonstrations)
        if margin < 0:
            raise ValueError(f"margin must not be negative, got {margin}")
        super().__init__(**options)
        value_network = as_levels(value_network)
        self.demonstrations = demonstrations
        self.demonstration_weight = demonstration_weight
        self.margin = margin
        self.first_beta = first_beta
        self.later_beta = later_beta
        self.double_dqn = double_dqn
        self.convert_to_functional(value_network, "value_network", create_target_params=True)
        # Made before the first forward pass, because its gamma is part of the state_dict.
        self.make_value_estimator(device=next(self.parameters()).device)

    def _required_keys(self) -> list[NestedKey]:
        names = self._transition_keys(self.value_network.in_keys)
        return (
            names if self.demonstrations == "none" else [*names, self.tensor_keys.is_demonstration]
        )

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses and detached diagnostics of a batch of transitions.

        Args:
            tensordict: transitions [...]; gets the priority written into it.

        Returns:
            ``loss_qvalue`` and ``loss_demonstration``, scalars or, with the reduction "none", of
            shape [...], whose sum is minimised; and without gradient the scalars
            ``demonstration_error`` (the term before its weight), ``td_error``, ``q_value`` and
            ``target_value`` (means over the batch; levels averaged).

        Raises:
            BatchError: an entry is missing, such as the demonstration flag if there is a term on
                demonstrations, or has another type or shape.
        """
        self._prepare(tensordict, next_key(self.tensor_keys.reward), 1)
        if tensordict.ndim != 1:
            return self._of_one_dimension(tensordict, self.tensor_keys.priority)
        target = self._target(tensordict)
        network = self.network("value_network")
        with self.value_network_params.to_module(network, preserve_module_state=False):
            levels = network(
                *(tensordict[key] for key in network.in_keys),
                tensordict[self.tensor_keys.action],
            )
        q = torch.stack([values.gather(1, chosen[:, None]) for values, chosen in levels], dim=-1)
        errors = F.huber_loss(q, target[..., None].expand_as(q), reduction="none")
        weights = self._importance_weights(tensordict)
        of_levels = [
            self._reduced(level[:, 0], tensordict, weights["critic"]) for level in errors.unbind(-1)
        ]
        difference = (q.detach() - target[..., None]).abs().mean(dim=-1)
        tensordict.set(self.tensor_keys.priority, difference)
        losses, is_demonstration = self._demonstration_losses(tensordict, levels)
        # The mean of "sdqfd" is over the batch.
        chosen = None if self.demonstrations == "sdqfd" else is_demonstration
        demonstration = self._reduced(losses, tensordict, weights["all"], chosen)

        def mean(values: Tensor, chosen: Tensor | None = None) -> Tensor:
            return self._reduced(values.detach(), tensordict, chosen=chosen, reduction="mean")

        return TensorDict(
            {
                "loss_qvalue": torch.stack(of_levels).sum(dim=0),
                "loss_demonstration": self.demonstration_weight * demonstration,
                "demonstration_error": mean(losses, chosen),
                "td_error": mean(difference),
                "q_value": mean(q),
                "target_value": mean(target),
            }
        )

    @torch.no_grad()
    def _target(self, tensordict: TensorDictBase) -> Tensor:
        """Return y [B, 1]."""
        network = self.network("value_network")
        observation = [tensordict[keys.NEXT][key] for key in network.in_keys]
        online, target = self.value_network_params, self.target_value_network_params
        with (online if self.double_dqn else target).to_module(
            network, preserve_module_state=False
        ):
            chosen, value = network.greedy(*observation)
        if self.double_dqn:
            with target.to_module(network, preserve_module_state=False):
                value = network.value_of(*observation, chosen)
        return self.value_estimator.value_estimate(tensordict, next_value=value)

    def _demonstration_losses(
        self, tensordict: TensorDictBase, levels: list[tuple[Tensor, Tensor]]
    ) -> tuple[Tensor, Tensor]:
        """Return the sums of the levels' terms [B], zero without demonstration, and flags [B]."""
        losses = levels[0][0].new_zeros(len(levels[0][0]))
        if self.demonstrations == "none":
            return losses, torch.zeros_like(losses, dtype=torch.bool)
        is_demonstration = tensordict[self.tensor_keys.is_demonstration].reshape(-1)
        if (
            is_demonstration.device.type != "cpu" or torch.compiler.is_compiling()
        ):  # for static shapes
            terms = torch.stack([self._term(i, *level) for i, level in enumerate(levels)])
            return torch.where(is_demonstration, terms.sum(dim=0), 0.0), is_demonstration
        rows = is_demonstration.nonzero()[:, 0]
        if len(rows):
            of_experts = [(q[rows], chosen[rows]) for q, chosen in levels]
            terms = torch.stack([self._term(i, *level) for i, level in enumerate(of_experts)])
            losses = losses.index_put((rows,), terms.sum(dim=0))
        return losses, is_demonstration

    def _term(self, level: int, q: Tensor, chosen: Tensor) -> Tensor:
        """Return the losses [n] of a level's values [n, N] and the experts' choices [n]."""
        if self.demonstrations == "adet":
            return cross_entropy(q, chosen, self.later_beta if level else self.first_beta)
        term = large_margin if self.demonstrations == "dqfd" else strict_large_margin
        return term(q, chosen, self.margin)
