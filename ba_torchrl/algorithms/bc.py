"""Behaviour cloning (Pomerleau, "ALVINN: An Autonomous Land Vehicle in a Neural Network", 1989)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import LossModule

from ba_torchrl.algorithms.base import ALGORITHMS, Control, Problem
from ba_torchrl.algorithms.imitators import Imitator, make_imitator
from ba_torchrl.algorithms.learner import Learner, LearnerConfig
from ba_torchrl.modules.base import NetworkConfig


@ALGORITHMS.register("bc")
class BCConfig(LearnerConfig):
    """Hyper-parameters of behaviour cloning.

    The loss is the mean squared error of sampled actions in close-loop tasks, and the cross-entropy
    of the Q network's choices in open-loop tasks; see `ba_torchrl.objectives.imitation`. All
    updates of the run are on the demonstrations.
    """

    controls: ClassVar[frozenset[Control]] = frozenset({"close_loop", "open_loop"})
    collects: ClassVar[bool] = False

    replay: Literal["uniform"] = "uniform"
    init: Literal["random"] = "random"

    def build(self, network: NetworkConfig, problem: Problem) -> BC:
        """Return a freshly initialised learner.

        Raises:
            ValueError: the network does not support the task's images or actions.
        """
        return BC(self, network, problem)


class BC(Learner):
    """A policy trained on demonstrations only.

    Args:
        config: hyper-parameters.
        network: builds the network of the policy.
        problem: images, actions, device, seed and length of the run.
    """

    def make_networks(self, network: NetworkConfig) -> Imitator:
        """Return the policy with its loss."""
        self.imitator = make_imitator(network, self.problem, self.images)
        return self.imitator

    def make_policy(self, networks: Imitator) -> TensorDictModuleBase:
        """Return the policy."""
        return networks.policy

    def make_loss(self, networks: Imitator) -> LossModule:
        """Return the loss between the policy and the demonstrated actions."""
        return networks.make_loss()

    def nearest_action(self, action: Tensor) -> Tensor:
        """Return the nearest action that the policy can choose."""
        return self.imitator.nearest_action(action)

    def on_demonstrations(self, episodes: Sequence[TensorDictBase]) -> None:
        """Store demonstrations with actions that the policy can choose.

        Args:
            episodes: TensorDicts [T].
        """
        super().on_demonstrations([self.imitator.as_demonstration(each) for each in episodes])
