"""Hyper-parameters of implicit Q-learning."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from ba_torchrl.algorithms.config import ALGORITHMS, LearnerConfig
from ba_torchrl.algorithms.parts.init import Init, RandomInit
from ba_torchrl.algorithms.parts.replay import Symmetric, Uniform
from ba_torchrl.core.choices import Control, Imitation


@ALGORITHMS.register("iql")
class IQLConfig(LearnerConfig):
    """Hyper-parameters of implicit Q-learning.

    Expectile and temperature are those of Kostrikov et al. (2021) for sparse rewards (AntMaze), tau
    is theirs as well. They subtract one from AntMaze's rewards; with rewards of 0 and 1, advantages
    are of the order of 1 - gamma, so that the policy is close to behaviour cloning. Unlike theirs,
    the critics have layer normalisation (`ba_torchrl.modules.actor_critic.critics`).
    """

    learner: ClassVar[str] = "ba_torchrl.algorithms.iql:IQL"
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
