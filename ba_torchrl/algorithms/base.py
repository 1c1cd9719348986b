"""Algorithm: a policy, a replay and an update, ready for the experiment loop."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ba_torchrl.actions import CloseLoopActions, OpenLoopActions
from ba_torchrl.config import StrictModel
from ba_torchrl.errors import ConfigError
from ba_torchrl.modules.base import NETWORKS, NetworkConfig
from ba_torchrl.registry import Registry

__all__ = ["ALGORITHMS", "NETWORKS", "Algorithm", "AlgorithmConfig", "NetworkConfig", "Problem"]

ALGORITHMS: Registry[type[AlgorithmConfig]] = Registry("algorithm", "ba_torchrl.algorithms")


@dataclass(frozen=True)
class Problem:
    """What an algorithm must know about the environments it learns from."""

    image_size: int
    actions: CloseLoopActions | OpenLoopActions
    """The action vector."""
    max_depth_m: float
    """Greatest value of the image."""
    in_hand_shape: tuple[int, int] | None
    """Channels and size of the in-hand image; None where there is none."""
    total_updates: int
    """Length of the run; schedules end with it."""
    seed: int
    device: torch.device


class Algorithm(ABC):
    """Learns from transitions; owned and driven by `ba_torchrl.training.experiment`."""

    policy: TensorDictModuleBase
    """From a root TensorDict of any batch shape to ``action``; explores as TorchRL's
    ``set_exploration_type`` says."""
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
            folder: is there, and empty.
        """

    @abstractmethod
    def load_replay(self, folder: Path) -> None:
        """Restore what `save_replay` wrote.

        Args:
            folder: may be gone afterwards.
        """


class AlgorithmConfig(StrictModel, ABC):
    """Hyper-parameters of an algorithm; building it needs a network and the problem."""

    control: ClassVar[Literal["open_loop", "close_loop"]]
    """Which tasks it learns."""

    def check(self, network: NetworkConfig) -> None:
        """Refuse a network that the algorithm does not go with.

        Raises:
            ConfigError: it does not.
        """
        if network.control != self.control:
            known = [name for name in NETWORKS if NETWORKS[name].control == self.control]
            raise ConfigError(
                f"{type(network).__name__} is a network for {network.control} tasks; this "
                f"algorithm learns {self.control} ones, with network: {', '.join(known)}"
            )

    @abstractmethod
    def build(self, network: NetworkConfig, problem: Problem) -> Algorithm:
        """Return a freshly initialised algorithm."""
