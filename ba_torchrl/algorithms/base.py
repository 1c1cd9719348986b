"""Algorithm: a policy, a replay and an update; the experiment loop drives it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ba_torchrl.actions import CloseLoopActions, OpenLoopActions
from ba_torchrl.algorithms.seeds import SeedUse, derive_seed
from ba_torchrl.config import StrictModel
from ba_torchrl.envs.images import ImageSpec
from ba_torchrl.errors import ConfigError
from ba_torchrl.modules.base import NETWORKS, Control, NetworkConfig
from ba_torchrl.registry import Registry

__all__ = [
    "ALGORITHMS",
    "NETWORKS",
    "Algorithm",
    "AlgorithmConfig",
    "Control",
    "NetworkConfig",
    "Problem",
]

ALGORITHMS: Registry[type[AlgorithmConfig]] = Registry("algorithm", "ba_torchrl.algorithms")


@dataclass(frozen=True)
class Problem:
    """What an algorithm knows about its environments and its run."""

    control: Control
    """Kind of control of the task."""
    images: Mapping[str, ImageSpec]
    """Declarations of the images that the environment observes, by key."""
    actions: CloseLoopActions | OpenLoopActions
    """The action vector."""
    total_updates: int
    """Length of the run, over which schedules extend."""
    seed: int
    device: torch.device

    def derived_seed(self, use: SeedUse) -> int:
        """Return the run's seed for one use of randomness."""
        return derive_seed(self.seed, use)


class Algorithm(ABC):
    """Learns from transitions; `ba_torchrl.training.experiment` collects them and calls it."""

    policy: TensorDictModuleBase
    """From a root TensorDict of any batch shape to ``action``; explores under TorchRL's
    exploration type RANDOM and is greedy under DETERMINISTIC."""
    updates: int = 0
    """Gradient updates so far."""
    stores_expert_action: ClassVar[bool] = False
    """Whether the environments are made with ``expert=True``, and transitions keep
    ``expert_action``."""

    def nearest_action(self, action: Tensor) -> Tensor:
        """Return the action that the policy can choose and that is nearest to another one.

        Demonstrations are executed with it, so that what is learnt is what was executed. By
        default every action can be chosen.

        Args:
            action: [..., A].
        """
        return action

    @abstractmethod
    def to_transitions(self, data: TensorDictBase, *, is_expert: bool) -> TensorDictBase:
        """Return the transitions [N] that the replay stores of collected data.

        Args:
            data: steps of any batch shape, those of an episode in order.
            is_expert: whether they are demonstrations.
        """

    def on_demonstrations(self, episodes: Sequence[TensorDictBase]) -> None:
        """Receive the demonstrations, before the first update; by default the replay stores them.

        Args:
            episodes: TensorDicts [T].
        """
        for episode in episodes:
            self.extend(self.to_transitions(episode, is_expert=True))

    @abstractmethod
    def extend(self, transitions: TensorDictBase) -> None:
        """Add transitions [N] to the replay; those with a fault are left out."""

    @property
    @abstractmethod
    def replay_size(self) -> int:
        """Number of transitions in the replay."""

    @abstractmethod
    def update(self) -> TensorDict:
        """Sample a batch, take one gradient step and return scalars without gradient.

        Raises:
            FloatingPointError: a loss is not finite.
        """

    def pretrain_update(self) -> TensorDict:
        """Take one update on the demonstrations, before the first collection; by default `update`.

        Counts in `updates`, returns and raises as `update` does.
        """
        return self.update()

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return networks, optimiser, counters and generators."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""

    @abstractmethod
    def save_replay(self, folder: Path) -> None:
        """Write the replay into a folder: transitions, priorities and the state of its draws.

        Args:
            folder: an empty folder.
        """

    @abstractmethod
    def load_replay(self, folder: Path) -> None:
        """Restore what `save_replay` wrote.

        Args:
            folder: may be deleted afterwards.
        """


class AlgorithmConfig(StrictModel, ABC):
    """Hyper-parameters of an algorithm; building it needs a network and the problem."""

    controls: ClassVar[frozenset[Control]]
    """Kinds of control of the tasks that it learns."""

    def check(self, network: NetworkConfig, control: Control) -> None:
        """Refuse a task or a network that the algorithm does not go with.

        Args:
            network: hyper-parameters of the network.
            control: kind of control of the task.

        Raises:
            ConfigError: the algorithm does not learn such tasks, or the network is for others.
        """
        if control not in self.controls:
            raise ConfigError(
                f"{type(self).__name__} learns {' and '.join(sorted(self.controls))} tasks, not "
                f"{control} ones"
            )
        if network.control != control:
            known = [name for name in NETWORKS if NETWORKS[name].control == control]
            raise ConfigError(
                f"{type(network).__name__} is a network for {network.control} tasks; "
                f"{control} tasks take network: {', '.join(known)}"
            )

    @abstractmethod
    def build(self, network: NetworkConfig, problem: Problem) -> Algorithm:
        """Return a freshly initialised algorithm."""
