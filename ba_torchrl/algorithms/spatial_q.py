"""Q-learning in spatial action spaces: DQN, ADET, DQfD and SDQfD (appendix G.1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from pydantic import Field
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import Transform
from torchrl.objectives import HardUpdate

from ba_torchrl.algorithms.base import ALGORITHMS, Control, Learner, LearnerConfig, Problem, SeedUse
from ba_torchrl.algorithms.parts.imitation import Margin, SpatialImitation
from ba_torchrl.algorithms.parts.optimizer import OptimizerConfig
from ba_torchrl.algorithms.parts.replay import Replay, Symmetric
from ba_torchrl.algorithms.parts.rotation import NoRotation, RigidRotation
from ba_torchrl.algorithms.spatial_actions import (
    demonstration_on_grid,
    make_spatial_values,
)
from ba_torchrl.data.transitions import Imitation
from ba_torchrl.modules.base import NetworkConfig
from ba_torchrl.modules.spatial.policy import SpatialPolicy, SpatialValues, spatial_policy
from ba_torchrl.objectives.dqn import LevelDQNLoss


class SpatialOptimizerConfig(OptimizerConfig):
    """Hyper-parameters of the steps along the gradient."""

    learning_rate: float = Field(default=1e-4, gt=0, le=1e3)
    weight_decay: float = Field(default=1e-5, ge=0)
    gradient_clamp: float | None = Field(default=1.0, gt=0)
    """Bound of each element of the gradient; reference implementation."""


@ALGORITHMS.register("spatial_q")
class SpatialQConfig(LearnerConfig):
    """Hyper-parameters of spatial Q-learning; its variants are presets in ``configs/algorithm``.

    The defaults are those of SDQfD in appendix G.1. Where the appendix gives no value, the default
    is that of the reference implementation, and the field says so.
    """

    controls: ClassVar[frozenset[Control]] = frozenset({"open_loop"})

    imitation: SpatialImitation = Margin(name="sdqfd")
    """The term on demonstrated actions."""
    optimizer: SpatialOptimizerConfig = SpatialOptimizerConfig()
    gamma: float = Field(default=0.95, gt=0, le=1)
    """Discount factor."""
    batch_size: int = Field(default=16, ge=1)
    target_interval: int = Field(default=100, ge=1)
    """Updates between two copies of the network to its target; reference implementation."""
    replay: Replay = Symmetric()
    rotation: RigidRotation = NoRotation()
    """Rigid transforms of sampled transitions."""
    epsilon_init: float = Field(default=0.0, ge=0, le=1)
    """Initial probability of a random action; in the appendix, the behaviour policy is greedy."""
    epsilon_end: float = Field(default=0.0, ge=0, le=1)
    """Final probability of a random action."""
    epsilon_updates: int = Field(default=1000, ge=1)
    """Updates over which that probability changes linearly, those on the demonstrations alone
    included."""

    @property
    def imitates(self) -> Imitation:
        """The executed action, which is on the grid of actions; none without such a term."""
        return "none" if self.imitation.name == "none" else "executed"

    def build(self, network: NetworkConfig, problem: Problem) -> SpatialQ:
        """Return a freshly initialised learner."""
        return SpatialQ(self, network, problem)


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
        """Restore the learner from a `state_dict` of any device."""
        super().load_state_dict(state)
        self.target_updater.counter = self.updates % self.config.target_interval
        self._set_epsilon()
