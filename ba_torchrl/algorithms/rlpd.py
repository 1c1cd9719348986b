"""Efficient online reinforcement learning with offline data (Ball et al., 2023; "RLPD").

Half of every batch is drawn from the demonstrations; critics are an ensemble with layer
normalisation, with targets from a random subset; and several critic updates are taken for each
update of the policy. There is no term that imitates the demonstrations.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
from pydantic import Field
from tensordict import TensorDict
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LinearLR

from ba_torchrl.algorithms.base import ALGORITHMS, Problem, SeedUse
from ba_torchrl.algorithms.parts.imitation import Behaviour, NoImitation
from ba_torchrl.algorithms.parts.replay import Symmetric
from ba_torchrl.algorithms.sac import SAC, SACConfig
from ba_torchrl.core.errors import ConfigError, PartError
from ba_torchrl.data.transitions import Imitation
from ba_torchrl.modules.actor_critic.critics import EnsembleCritic
from ba_torchrl.modules.base import NETWORKS, ActorCritic, ActorCriticSpec, NetworkConfig
from ba_torchrl.objectives.rlpd import RLPDLoss


@ALGORITHMS.register("rlpd")
class RLPDConfig(SACConfig):
    """Hyper-parameters of RLPD: those of SAC, and of the ensemble.

    Ball et al. (2023) have ten critics, choose a subset of one or two and the entropy backup for
    each environment, and take 20 critic updates per step in environments with vector observations.
    The values that SAC has too are SAC's.
    """

    is_compilable: ClassVar[bool] = False
    """False: the host draws members of the ensemble in each update."""

    replay: Symmetric = Symmetric()
    critics: int = Field(default=10, ge=2)
    """Number of critics in the ensemble."""
    subset: int = Field(default=2, ge=1)
    """Number of target critics, drawn in each update, whose minimum is the target."""
    critic_updates: int = Field(default=4, ge=1)
    """Critic updates per update of the policy, each on another batch."""
    entropy_backup: bool = False
    """Whether targets have the entropy term."""
    imitation: Behaviour = NoImitation()
    """SACfD's behaviour term, which Ball et al. (2023) do not have."""

    @property
    def imitates(self) -> Imitation:
        """No action without such a term: all transitions have the same loss."""
        return "none" if self.init.name == "random" and self.imitation.name == "none" else "expert"

    def build(self, network: NetworkConfig, problem: Problem) -> RLPD:
        """Return a freshly initialised learner."""
        if self.subset > self.critics:
            raise ConfigError(f"subset: {self.subset} of {self.critics} critics cannot be drawn")
        return RLPD(self, network, problem)


class RLPD(SAC):
    """A squashed Gaussian policy and an ensemble of critics on a shared encoder."""

    config: RLPDConfig
    loss: RLPDLoss

    @property
    def network_spec(self) -> ActorCriticSpec:
        """As for `SAC`, with the number of critics."""
        return replace(super().network_spec, critics=self.config.critics)

    def make_networks(self, network: NetworkConfig) -> ActorCritic:
        """Return actor, encoder and ensemble."""
        networks = super().make_networks(network)
        if not isinstance(networks.critic, EnsembleCritic):
            name = NETWORKS.name_of(type(network))
            raise PartError("network", name, "builds no ensemble of critics; take another one")
        return networks

    def make_loss(self, networks: ActorCritic) -> RLPDLoss:
        """Return the loss of actor, critics and temperature."""
        seed = self.problem.derived_seed(SeedUse.ENSEMBLE)
        return super().make_loss(networks, RLPDLoss, subset=self.config.subset, seed=seed)

    def make_scheduler(self, optimizer: Optimizer) -> LinearLR:
        """Return the schedule of the learning rate, which steps once per critic update."""
        total, config = self.problem.total_updates, self.config
        further = (total - config.first_updates) * (config.critic_updates - 1)
        return config.optimizer.schedule(optimizer, total + further)

    def update(self) -> TensorDict:
        """Take the critic updates, the last one together with that of policy and temperature."""
        if self.updates >= self.config.first_updates:
            for _ in range(self.config.critic_updates - 1):
                self.step(self.sample(), [self.loss.critic_loss])
        return super().update()

    def generators(self) -> dict[str, torch.Generator]:
        """Return the generator of the subsets of critics."""
        return {"ensemble": self.loss.generator}
