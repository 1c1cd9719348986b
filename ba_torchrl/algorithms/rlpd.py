"""Efficient online reinforcement learning with offline data (Ball et al., 2023; "RLPD").

Half of every batch is drawn from the demonstrations; critics are an ensemble with layer
normalisation, with targets from a random subset; and several critic updates are taken for each
update of the policy. There is no term that imitates the demonstrations.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from tensordict import TensorDict
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LinearLR

from ba_torchrl.algorithms.base import SeedUse
from ba_torchrl.algorithms.rlpd_config import RLPDConfig
from ba_torchrl.algorithms.sac import SAC
from ba_torchrl.core.errors import PartError
from ba_torchrl.modules.actor_critic.critics import EnsembleCritic
from ba_torchrl.modules.base import ActorCritic, ActorCriticSpec
from ba_torchrl.modules.config import NETWORKS, NetworkConfig
from ba_torchrl.objectives.rlpd import RLPDLoss


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
