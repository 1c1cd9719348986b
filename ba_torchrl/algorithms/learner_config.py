"""Hyper-parameters that all learners have in common."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from ba_torchrl.algorithms.base import AlgorithmConfig, NetworkConfig
from ba_torchrl.config import changed
from ba_torchrl.data.replay.make import ReplayKind
from ba_torchrl.data.transitions import Imitation
from ba_torchrl.objectives.base import WeightedTerms, WeightNorm

Init = Literal["random", "bc"]
"""How the policy is initialised."""

_OF_PRIORITIES = (
    "priority_exponent",
    "importance_exponent",
    "importance_weighted",
    "importance_norm",
    "expert_bonus",
)
"""Fields of a prioritised replay."""


class LearnerConfig(AlgorithmConfig):
    """Hyper-parameters of every algorithm that learns from a replay.

    Learning rate, batch, capacity, exponents and bonus are those of appendix G.2. Each other field
    says where its default is from.
    """

    is_compilable: ClassVar[bool] = True

    learning_rate: float = Field(default=1e-3, gt=0, le=1e3)
    """Learning rate of Adam."""
    learning_rate_end_factor: float = Field(default=1.0, gt=0, le=1)
    """Final fraction of the learning rate, which decreases linearly over the run; constant in the
    reference implementation."""
    weight_decay: float = Field(default=0.0, ge=0)
    """Adam's L2 term on the networks' parameters; none in the reference implementation's SAC."""
    gradient_clamp: float | None = Field(default=None, gt=0)
    """Bound of each element of the networks' gradient; None for no bound, as in the reference
    implementation's SAC."""
    policy_average: float = Field(default=0.0, ge=0, lt=1)
    """Decay of the exponential moving average of the policy's parameters with which the policy
    acts; 0 for acting with the last parameters. None in the appendix."""
    batch_size: int = Field(default=64, ge=1)
    """Transitions per update."""
    replay: ReplayKind = "uniform"
    """Sampling of transitions: "uniform", "prioritized" or "symmetric"."""
    buffer_size: int = Field(default=100_000, ge=1)
    """Transitions in the replay, demonstrations and others together."""
    priority_exponent: float = Field(default=0.6, ge=0)
    """Exponent alpha of the priorities of a prioritised replay."""
    importance_exponent: float = Field(default=0.4, ge=0, le=1)
    """Initial exponent beta of the importance weights, which increases to 1 over the run; with 0,
    the weights are 1 throughout."""
    importance_weighted: WeightedTerms = "critic_and_policy"
    """Terms of the loss that the importance weights multiply: "none", "critic",
    "critic_and_policy", or "all", which adds those on demonstrations and the temperature. The
    appendix does not say; the reference implementation computes weights and does not use them."""
    importance_norm: WeightNorm = "max"
    """Statistic of a batch by which its importance weights are divided: "max", as in Schaul et al.
    (2016), or "mean"."""
    expert_bonus: float = Field(default=1.0, ge=0)
    """Added to the priority of demonstrations."""
    init: Init = "random"
    """Initialisation of the policy: "random" weights, or "bc", for which the run's pretraining
    updates are behaviour cloning of the demonstrations instead of updates of the algorithm. Critics
    are not trained meanwhile: without a behaviour term, SAC then unlearns the policy."""

    @model_validator(mode="after")
    def _check_halves(self) -> Self:
        if self.replay == "symmetric" and self.batch_size < 2:
            raise ValueError("batch_size must be at least 2 with a symmetric replay, half of each")
        return self

    def without_effect(self, network: NetworkConfig) -> Iterator[str]:
        """As for `AlgorithmConfig`: fields of another replay."""
        if self.replay != "prioritized":
            yield from changed(self, _OF_PRIORITIES, "without replay='prioritized'")
        elif self.importance_weighted == "none":
            yield from changed(self, ["importance_norm"], "with importance_weighted='none'")

    @property
    def imitates(self) -> Imitation:
        """Which action the loss imitates, and on which transitions; by default the executed action
        of demonstrations, and with ``init="bc"`` the expert's."""
        return "expert" if self.init == "bc" else "executed"

    @property
    def init_entropy_weight(self) -> float:
        """Weight of the policy's negative entropy in the updates of behaviour cloning of
        ``init="bc"``."""
        return 0.0

    @property
    def pretraining_option(self) -> str | None:
        """As for `AlgorithmConfig`."""
        return "init: 'bc'" if self.init == "bc" else None

    @property
    def replay_capacity(self) -> int:
        """As for `AlgorithmConfig`."""
        return self.buffer_size
