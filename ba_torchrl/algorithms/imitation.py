"""Imitation of an expert: behaviour cloning, and DAgger in the states that the policy visits.

The policy of close-loop tasks is the squashed Gaussian of SAC, that of open-loop tasks the greedy
policy of a spatial Q network. The experts are functions of the scene, so the environment returns
the expert's action in every state that DAgger visits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import Transform
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.objectives import LossModule

from ba_torchrl.algorithms.acting import acting_keys
from ba_torchrl.algorithms.base import Learner, Problem, SeedUse
from ba_torchrl.algorithms.imitation_config import DAggerConfig, ImitationConfig
from ba_torchrl.algorithms.spatial_actions import demonstration_on_grid, make_spatial_values
from ba_torchrl.core import keys
from ba_torchrl.core.generators import seeded_generator
from ba_torchrl.modules.actor_critic.gaussian_policy import squashed_gaussian_policy
from ba_torchrl.modules.config import NetworkConfig
from ba_torchrl.modules.spatial.policy import SpatialActions, SpatialPolicy, spatial_policy
from ba_torchrl.objectives.imitation import BehaviourCloningLoss, LevelCrossEntropyLoss


class BC(Learner):
    """A policy trained on demonstrations only."""

    config: ImitationConfig

    @property
    def equal_moves(self) -> int:
        """Largest number of equal moves, any of which is imitated; 0 for the expert's own alone."""
        return self.problem.equal_moves if self.config.equal_moves else 0

    @property
    def actions(self) -> SpatialActions | None:
        """The grid of actions of an open-loop policy; None in close loop."""
        is_grid = self.problem.control == "open_loop"
        return self.trained_policy.module.values.actions if is_grid else None

    def make_networks(self, network: NetworkConfig) -> nn.Module:
        """Return the actor of an actor-critic network, or a spatial Q network."""
        if self.problem.control == "close_loop":
            return network.build(self.network_spec).actor.to(self.problem.device)
        return make_spatial_values(network, self.problem, self.images)

    def make_policy(self, networks: nn.Module) -> TensorDictModuleBase:
        if self.problem.control == "close_loop":
            return squashed_gaussian_policy(networks, self.observation_keys)
        seed = self.problem.derived_seed(SeedUse.EXPLORATION)
        return spatial_policy(SpatialPolicy(networks, seed))

    def make_loss(self, networks: nn.Module) -> LossModule:
        """Return the divergence of sampled actions from the expert's, with gradients at the ends of
        the range, or the cross-entropy of every level's values with the expert's choices."""
        if self.problem.control == "close_loop":
            loss = BehaviourCloningLoss(self.make_policy(networks), "kl")
        else:
            loss = LevelCrossEntropyLoss(networks, of_sets=self.equal_moves > 0)
        loss.set_keys(action=keys.TARGET_MOVES if self.equal_moves else keys.TARGET_ACTION)
        return loss

    def make_transforms(self, networks: nn.Module) -> list[Transform]:
        """Return the rotation or the rigid transforms of sampled transitions."""
        rotation = self.config.rotation
        if self.problem.control == "close_loop":
            return rotation.build(self.problem, self.images, self.vectors)
        return rotation.build(self.problem, self.images, networks.actions, keys.TARGET_ACTION)

    def nearest_action(self, action: Tensor) -> Tensor:
        return action if self.actions is None else self.actions.nearest(action)

    def on_demonstrations(self, episodes: Sequence[TensorDictBase]) -> None:
        """Store the steps of demonstrations [T] in which the expert's action is known, as an action
        that the policy can choose."""
        for episode in episodes:
            if self.actions is not None:
                episode = demonstration_on_grid(episode, self.actions, self.images)
            data = self.to_transitions(episode, is_demonstration=True)
            self.extend(data[data[keys.IS_DEMONSTRATION].squeeze(-1)])


class MixedPolicy(TensorDictModuleBase):
    """A policy that executes the expert's action in a random part of the steps.

    It does so under TorchRL's exploration type RANDOM only.

    Args:
        policy: from the observation to ``action``.
        actions: the actions that the policy can choose; None for all.
        seed: of the choice between the two.
    """

    beta: Tensor

    def __init__(
        self, policy: TensorDictModuleBase, actions: SpatialActions | None, seed: int
    ) -> None:
        super().__init__()
        self.policy = policy
        self.register_buffer("beta", torch.zeros(()))  # among the weights that workers receive
        self.in_keys = list(policy.in_keys)
        self.out_keys = acting_keys(policy)
        self._actions = actions
        self.generator = seeded_generator(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of a root TensorDict of any batch shape.

        Args:
            tensordict: observation; with ``expert_action`` if beta is positive.
        """
        out = self.policy(tensordict)
        if exploration_type() != ExplorationType.RANDOM or self.beta == 0:
            return out
        draws = torch.rand(
            *out.batch_size, 1, generator=self.generator, device="cpu", dtype=torch.float32
        )
        expert = out[keys.EXPERT_ACTION]
        if self._actions is not None:
            expert = self._actions.nearest(expert)
        is_expert = draws.to(expert.device) < self.beta
        return out.set(keys.ACTION, torch.where(is_expert, expert, out[keys.ACTION]))


class DAgger(BC):
    """A policy trained on the expert's actions in the states of both."""

    config: DAggerConfig
    policy: MixedPolicy

    def __init__(self, config: DAggerConfig, network: NetworkConfig, problem: Problem) -> None:
        super().__init__(config, network, problem)
        seed = problem.derived_seed(SeedUse.MIXTURE)
        self.policy = MixedPolicy(self.policy, self.actions, seed).to(problem.device).eval()
        self._set_beta()

    def update(self) -> TensorDict:
        """Take one step as `Learner.update`, and update beta."""
        scalars = super().update()
        self._set_beta()
        return scalars

    def _set_beta(self) -> None:
        config = self.config
        beta = config.beta_init * max(1 - self.updates / config.beta_updates, 0.0)
        self.policy.beta.fill_(beta)

    def generators(self) -> dict[str, torch.Generator]:
        """Return the generator of the choice between the actions of policy and expert."""
        return {"mixture": self.policy.generator}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._set_beta()
