"""Policies that imitate an expert: one for each control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import LossModule

from ba_torchrl.algorithms.base import NetworkConfig, Problem
from ba_torchrl.algorithms.seeds import SeedUse
from ba_torchrl.algorithms.spatial_actions import demonstration_on_grid, make_spatial_values
from ba_torchrl.envs import keys
from ba_torchrl.envs.images import ImageSpec
from ba_torchrl.modules.actor_critic.gaussian_policy import squashed_gaussian_policy
from ba_torchrl.modules.base import ActorCriticSpec
from ba_torchrl.modules.spatial.policy import SpatialPolicy, spatial_policy
from ba_torchrl.objectives.imitation import BehaviourCloningLoss, LevelCrossEntropyLoss


class Imitator(Protocol):
    """A policy with its loss on the expert's actions."""

    policy: TensorDictModuleBase
    """From the observation to ``action``."""

    def make_loss(self) -> LossModule:
        """Return the loss between the policy and the expert's actions under ``action``."""
        ...

    def nearest_action(self, action: Tensor) -> Tensor:
        """Return the action nearest to a given one [..., A] that the policy can choose."""
        ...

    def as_demonstration(self, episode: TensorDictBase) -> TensorDictBase:
        """Return an expert's episode [T] with actions that the policy can choose."""
        ...


class GaussianImitator:
    """The squashed Gaussian policy of SAC, for close-loop tasks.

    Args:
        network: builds the actor.
        problem: actions and device.
        images: declarations of the network's input images.
    """

    def __init__(
        self, network: NetworkConfig, problem: Problem, images: Mapping[str, ImageSpec]
    ) -> None:
        actor = network.build(ActorCriticSpec(images, problem.actions.sequence)).actor
        actor.to(problem.device)
        self.policy = squashed_gaussian_policy(actor, [*images, keys.HOLDING])

    def make_loss(self) -> LossModule:
        """Return the distance of sampled actions, with gradients at the ends of the range."""
        return BehaviourCloningLoss(self.policy, "kl")

    def nearest_action(self, action: Tensor) -> Tensor:
        """Return the action: the policy can choose every action."""
        return action

    def as_demonstration(self, episode: TensorDictBase) -> TensorDictBase:
        """Return the episode."""
        return episode


class SpatialImitator:
    """The greedy policy of a spatial Q network, for open-loop tasks.

    Args:
        network: builds the Q network.
        problem: actions, device and seed.
        images: declarations of the network's input images.
    """

    def __init__(
        self, network: NetworkConfig, problem: Problem, images: Mapping[str, ImageSpec]
    ) -> None:
        self._images = images
        self._values = make_spatial_values(network, problem, images)
        seed = problem.derived_seed(SeedUse.EXPLORATION)
        self.policy = spatial_policy(SpatialPolicy(self._values, seed))

    def make_loss(self) -> LossModule:
        """Return the cross-entropy of every level's values with the expert's choice."""
        return LevelCrossEntropyLoss(self._values)

    def nearest_action(self, action: Tensor) -> Tensor:
        """Return the nearest action on the grid."""
        return self._values.actions.nearest(action)

    def as_demonstration(self, episode: TensorDictBase) -> TensorDictBase:
        """Return the episode with the nearest actions on the grid."""
        return demonstration_on_grid(episode, self._values.actions, self._images)


def make_imitator(
    network: NetworkConfig, problem: Problem, images: Mapping[str, ImageSpec]
) -> Imitator:
    """Return the imitator for the task's control.

    Args:
        network: builds the network.
        problem: control, actions, device and seed.
        images: declarations of the network's input images.
    """
    kinds = {"close_loop": GaussianImitator, "open_loop": SpatialImitator}
    return kinds[problem.control](network, problem, images)


class ImitationLearning:
    """Mixin of a `Learner` whose policy is trained by the loss of an `Imitator` alone."""

    problem: Problem
    images: Mapping[str, ImageSpec]

    def make_networks(self, network: NetworkConfig) -> Imitator:
        """Return the policy with its loss."""
        self.imitator = make_imitator(network, self.problem, self.images)
        return self.imitator

    def make_policy(self, networks: Imitator) -> TensorDictModuleBase:
        """Return the policy."""
        return networks.policy

    def make_loss(self, networks: Imitator) -> LossModule:
        """Return the loss between the policy and the expert's actions."""
        return networks.make_loss()

    def nearest_action(self, action: Tensor) -> Tensor:
        """Return the nearest action that the policy can choose."""
        return self.imitator.nearest_action(action)

    @property
    def has_expert_action(self) -> bool:
        """False: the expert's action is stored as ``action``."""
        return False

    def to_transitions(self, data: TensorDictBase, *, is_expert: bool) -> TensorDict:
        """Return the transitions [N], with the expert's action in place of the executed one.

        The loss reads states and labels only, not what followed. Demonstrations without
        ``expert_action`` keep the executed action.

        Raises:
            KeyError: collected data lack ``expert_action``.
        """
        if not is_expert or keys.EXPERT_ACTION in data:
            labels = data[keys.EXPERT_ACTION]
            data = data.exclude(keys.EXPERT_ACTION, keys.IS_EXPERT).set(keys.ACTION, labels)
        return super().to_transitions(data, is_expert=is_expert)

    def on_demonstrations(self, episodes: Sequence[TensorDictBase]) -> None:
        """Store the steps of demonstrations in which the expert's action is known, as an action
        that the policy can choose.

        Args:
            episodes: TensorDicts [T].
        """
        for episode in episodes:
            data = self.to_transitions(self.imitator.as_demonstration(episode), is_expert=True)
            self.extend(data[data[keys.IS_EXPERT].squeeze(-1)])
