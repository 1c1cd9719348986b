"""Interface of collections."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from ba_torchrl.algorithms.base import Learner
from ba_torchrl.core.config import WorkerOptions
from ba_torchrl.envs.episode_positions import EpisodePosition
from ba_torchrl.training.collectors.config import COLLECTORS, CollectorConfig

__all__ = ["COLLECTORS", "Collection", "CollectionProblem", "CollectorConfig"]


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
