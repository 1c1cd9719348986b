"""Behaviour cloning (Pomerleau, "ALVINN: An Autonomous Land Vehicle in a Neural Network", 1989)."""

from __future__ import annotations

from typing import ClassVar, Literal

from ba_torchrl.algorithms.base import ALGORITHMS, Control, Problem
from ba_torchrl.algorithms.imitators import ImitationLearning
from ba_torchrl.algorithms.learner import Learner
from ba_torchrl.algorithms.learner_config import LearnerConfig
from ba_torchrl.modules.base import NetworkConfig


@ALGORITHMS.register("bc")
class BCConfig(LearnerConfig):
    """Hyper-parameters of behaviour cloning.

    The loss is the divergence of sampled actions from the expert's in close-loop tasks, and the
    cross-entropy of the Q network's choices in open-loop tasks; see
    `ba_torchrl.objectives.imitation`. All updates of the run are on the demonstrations.
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


class BC(ImitationLearning, Learner):
    """A policy trained on demonstrations only.

    Args:
        config: hyper-parameters.
        network: builds the network of the policy.
        problem: images, actions, device, seed and length of the run.
    """
