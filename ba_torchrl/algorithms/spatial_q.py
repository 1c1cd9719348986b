"""Q-learning in spatial action spaces: DQN, ADET, DQfD and SDQfD (appendix G.1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import Transform
from torchrl.objectives import HardUpdate

from ba_torchrl.algorithms.base import Learner, Problem, SeedUse
from ba_torchrl.algorithms.spatial_actions import demonstration_on_grid, make_spatial_values
from ba_torchrl.algorithms.spatial_q_config import SpatialQConfig
from ba_torchrl.modules.config import NetworkConfig
from ba_torchrl.modules.spatial.policy import SpatialPolicy, SpatialValues, spatial_policy
from ba_torchrl.objectives.dqn import LevelDQNLoss


class SpatialQ(Learner):
    """A network of spatial Q values with a target network that is copied at intervals."""

    config: SpatialQConfig
    loss: LevelDQNLoss

    def __init__(self, config: SpatialQConfig, network: NetworkConfig, problem: Problem) -> None:
        super().__init__(config, network, problem)
        self.actions = self.trained_policy.module.values.actions
        self._set_epsilon()

    def make_networks(self, network: NetworkConfig) -> SpatialValues:
        """Return the network, wrapped as values of the environment's actions."""
        return make_spatial_values(network, self.problem, self.images)

    def make_policy(self, networks: SpatialValues) -> TensorDictModule:
        """Return the epsilon-greedy policy."""
        seed = self.problem.derived_seed(SeedUse.EXPLORATION)
        return spatial_policy(SpatialPolicy(networks, seed))

    @property
    def explorer(self) -> SpatialPolicy:
        """The module that chooses actions."""
        return self.policy.policy.module

    def make_loss(self, networks: SpatialValues) -> LevelDQNLoss:
        """Return the TD loss with the term on demonstrated actions."""
        config = self.config
        loss = LevelDQNLoss(
            networks,
            demonstrations=config.imitation.name,
            **config.imitation.loss_options,
            **config.replay.loss_options,
        )
        return loss.make_value_estimator(gamma=config.gamma)

    def make_target_updater(self, loss: LevelDQNLoss) -> HardUpdate:
        """Return the updater that copies the network to its target."""
        # TorchRL copies when its counter exceeds the interval, one update later.
        return HardUpdate(loss, value_network_update_interval=self.config.target_interval - 1)

    def make_transforms(self, networks: SpatialValues) -> list[Transform]:
        """Return the rigid transforms of sampled transitions."""
        return self.config.rotation.build(self.problem, self.images, networks.actions)

    def nearest_action(self, action: Tensor) -> Tensor:
        """Return the nearest action that the network's levels can choose."""
        return self.actions.nearest(action)

    def on_demonstrations(self, episodes: Sequence[TensorDictBase]) -> None:
        """Store demonstrations [T], with actions replaced by the nearest ones on the grid."""
        on_grid = [demonstration_on_grid(each, self.actions, self.images) for each in episodes]
        super().on_demonstrations(on_grid)

    def update(self) -> TensorDict:
        """Take one step as `Learner.update`, and update epsilon."""
        scalars = super().update()
        self._set_epsilon()
        return scalars

    def _set_epsilon(self) -> None:
        config = self.config
        share = min(self.updates / config.epsilon_updates, 1.0)
        epsilon = config.epsilon_init + share * (config.epsilon_end - config.epsilon_init)
        self.explorer.epsilon.fill_(epsilon)

    def generators(self) -> dict[str, torch.Generator]:
        """Return the generator of random actions."""
        return {"exploration": self.explorer.generator}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.target_updater.counter = self.updates % self.config.target_interval
        self._set_epsilon()
