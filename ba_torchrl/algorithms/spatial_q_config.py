"""Hyper-parameters of Q-learning in spatial action spaces."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from ba_torchrl.algorithms.config import ALGORITHMS, LearnerConfig
from ba_torchrl.algorithms.parts.imitation import Margin, SpatialImitation
from ba_torchrl.algorithms.parts.optimizer import OptimizerConfig
from ba_torchrl.algorithms.parts.replay import Replay, Symmetric
from ba_torchrl.algorithms.parts.rotation import NoRotation, RigidRotation
from ba_torchrl.core.choices import Control, Imitation


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

    learner: ClassVar[str] = "ba_torchrl.algorithms.spatial_q:SpatialQ"
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
