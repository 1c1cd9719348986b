"""Interface of the collectors, and their registry."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from ba_torchrl.algorithms.base import Learner
from ba_torchrl.core.config import StrictModel, WorkerOptions
from ba_torchrl.core.registry import Registry
from ba_torchrl.envs.episode_positions import EpisodePosition


@dataclass(frozen=True)
class CollectionProblem:
    """What a collector needs of a run."""

    learner: Learner
    """Its policy explores, with the weights after the latest update."""
    device: torch.device
    """Device of the learner."""
    num_envs: int
    """Number of environments."""
    seed: int
    """Seed of the first environment."""
    make_env: Callable[[int, int], EnvBase]
    """From a number of environments and the seed of the first to a vector of environments on the
    CPU. Other processes and machines can call it."""
    make_policy: Callable[[int], TensorDictModuleBase]
    """From a seed to an untrained policy on the CPU. Other processes and machines can call it."""
    workers: WorkerOptions
    """How processes start and when they are replaced."""


class Collection(ABC):
    """An iterator over batches of transitions, TensorDicts [N] on the CPU.

    The transitions of an environment are in their order, and each has been returned once. The entry
    ``env_index`` numbers the environments from 0 on.
    """

    scalars: dict[str, float]
    """Figures for the log, by name."""

    def __init__(self) -> None:
        self.scalars = {}

    def __iter__(self) -> Collection:
        return self

    @abstractmethod
    def __next__(self) -> TensorDict:
        """Return the next batch.

        Raises:
            RuntimeError: the environments or their workers failed too often in a row.
        """

    def get_positions(self) -> list[EpisodePosition] | None:
        """Return the position of each environment in its episodes; None if they are unknown."""
        return None

    @abstractmethod
    def close(self) -> None:
        """End the workers and close the environments; further calls have no effect."""


class CollectorConfig(StrictModel, ABC):
    """Options of a collector."""

    resources: ClassVar[frozenset[str]] = frozenset()
    """Fields that do not affect learning; a resumed run may have other values."""

    def check(self, num_envs: int) -> None:
        """Raise `ConfigError` unless the collector can be used, before anything starts."""
        return

    @abstractmethod
    def start(
        self, problem: CollectionProblem, positions: Sequence[EpisodePosition] | None
    ) -> Collection:
        """Start to collect.

        Args:
            problem: the run's environments and policy.
            positions: that `Collection.get_positions` returned, from which the environments
                continue; None to start new episodes.
        """


COLLECTORS: Registry[type[CollectorConfig]] = Registry(
    "collector", "ba_torchrl.training.collectors", CollectorConfig
)
