"""Implicit Q-learning from offline data (Kostrikov et al., 2021), also online after it.

The value of a state is an upper expectile of the values of the actions in the data, so no action
outside the data is evaluated. The policy is regressed on the data's actions, weighted by their
exponentiated advantage. A run with ``pretrain_updates`` equal to ``total_updates`` learns from
the demonstrations alone; with fewer, the remaining updates are online.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, ClassVar, NamedTuple

from pydantic import Field
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import SoftUpdate

from ba_torchrl.algorithms.base import (
    ALGORITHMS,
    Control,
    Learner,
    LearnerConfig,
    LossFunction,
    Problem,
)
from ba_torchrl.algorithms.parts.init import Init, RandomInit
from ba_torchrl.algorithms.parts.replay import Symmetric, Uniform
from ba_torchrl.core import keys
from ba_torchrl.data.transitions import Imitation
from ba_torchrl.modules.actor_critic.critics import ActionValue, StateValue
from ba_torchrl.modules.actor_critic.gaussian_policy import truncated_gaussian_policy
from ba_torchrl.modules.base import NetworkConfig
from ba_torchrl.objectives.iql import EvalModeTargetsIQLLoss


@ALGORITHMS.register("iql")
class IQLConfig(LearnerConfig):
    """Hyper-parameters of implicit Q-learning.

    Expectile and temperature are those of Kostrikov et al. (2021) for sparse rewards (AntMaze), tau
    is theirs as well. They subtract one from AntMaze's rewards; with rewards of 0 and 1, advantages
    are of the order of 1 - gamma, so that the policy is close to behaviour cloning. Unlike theirs,
    the critics have layer normalisation (`ba_torchrl.modules.actor_critic.critics`).
    """

    controls: ClassVar[frozenset[Control]] = frozenset({"close_loop"})

    replay: Annotated[Uniform | Symmetric, Field(discriminator="name")] = Uniform()
    init: Init = RandomInit()
    """Initialisation of the policy."""
    expectile: float = Field(default=0.9, gt=0, lt=1)
    """Expectile of the actions' values that is the value of a state."""
    temperature: float = Field(default=10.0, ge=0)
    """Inverse temperature: factor of the advantage in the exponent of a sample's weight."""
    std_min: float = Field(default=0.3, gt=0, le=1)
    """Least standard deviation of the policy, which bounds the likelihood of the data. With 0.1,
    the largest errors can drive a mean to an end of the range, where it stays."""
    gamma: float = Field(default=0.99, gt=0, le=1)
    """Discount factor."""
    tau: float = Field(default=0.005, gt=0, le=1)
    """Weight of the critics in the update of their targets."""

    @property
    def imitates(self) -> Imitation:
        """No action, except in behaviour cloning: all transitions have the same loss."""
        return "none" if self.init.name == "random" else "expert"

    @property
    def first_updates(self) -> int:
        """Those of the initialisation."""
        return self.init.updates

    def build(self, network: NetworkConfig, problem: Problem) -> IQL:
        """Return a freshly initialised learner."""
        return IQL(self, network, problem)


class IQLNetworks(NamedTuple):
    """The plain modules of implicit Q-learning, each with an encoder of its own."""

    actor: nn.Module
    qvalues: list[ActionValue]
    value: StateValue


class IQL(Learner):
    """A truncated Gaussian policy, two critics and a state value."""

    config: IQLConfig
    loss: EvalModeTargetsIQLLoss

    def make_networks(self, network: NetworkConfig) -> IQLNetworks:
        """Return actor, critics and state value."""
        spec = replace(self.network_spec, critics=1)
        # four networks, since those of an actor and its encoder may share parameters
        first, second, third, fourth = (network.build(spec) for _ in range(4))
        device = self.problem.device
        return IQLNetworks(
            fourth.actor.to(device),
            [ActionValue(each.encoder, each.critic).to(device) for each in (first, second)],
            StateValue(third.encoder, third.critic, spec.action_size).to(device),
        )

    def make_policy(self, networks: IQLNetworks) -> ProbabilisticActor:
        """Return the truncated Gaussian of the actor."""
        return truncated_gaussian_policy(
            networks.actor, self.observation_keys, std_min=self.config.std_min
        )

    def make_loss(self, networks: IQLNetworks) -> EvalModeTargetsIQLLoss:
        """Return TorchRL's loss without ``vmap``, under which the CPU's compiled convolutions and
        pools are not available."""
        inputs = [*self.observation_keys, keys.ACTION]
        loss = EvalModeTargetsIQLLoss(
            self.make_policy(networks),
            [TensorDictModule(q, inputs, ["state_action_value"]) for q in networks.qvalues],
            TensorDictModule(networks.value, self.observation_keys, ["state_value"]),
            loss_function="l2",
            temperature=self.config.temperature,
            expectile=self.config.expectile,
            deactivate_vmap=True,
        )
        loss.make_value_estimator(gamma=self.config.gamma)
        return loss

    def make_first_losses(
        self, policy: ProbabilisticActor, loss: EvalModeTargetsIQLLoss
    ) -> list[tuple[int, LossFunction]]:
        """Return the loss of the initialisation."""
        return self.config.init.build(policy)

    def make_target_updater(self, loss: EvalModeTargetsIQLLoss) -> SoftUpdate:
        """Return the soft update of the critics' targets."""
        return SoftUpdate(loss, tau=self.config.tau)
