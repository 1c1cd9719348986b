"""Implicit Q-learning from offline data (Kostrikov et al., 2021), also online after it.

The value of a state is an upper expectile of the values of the actions in the data, so no action
outside the data is evaluated. The policy is regressed on the data's actions, weighted by their
exponentiated advantage. A run with ``pretrain_updates`` equal to ``total_updates`` learns from
the demonstrations alone; with fewer, the remaining updates are online.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import SoftUpdate

from ba_torchrl.algorithms.base import Learner, LossFunction
from ba_torchrl.algorithms.iql_config import IQLConfig
from ba_torchrl.core import keys
from ba_torchrl.modules.actor_critic.critics import ActionValue, StateValue
from ba_torchrl.modules.actor_critic.gaussian_policy import truncated_gaussian_policy
from ba_torchrl.modules.config import NetworkConfig
from ba_torchrl.objectives.iql import EvalModeTargetsIQLLoss


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
