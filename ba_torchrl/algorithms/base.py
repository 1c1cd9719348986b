"""The interface of algorithms: a policy, a replay and an update, called by the experiment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ba_torchrl.actions import CloseLoopActions, OpenLoopActions
from ba_torchrl.algorithms.compilation import CompileMode
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
    """Description of the environments and the run for which an algorithm is built."""

    control: Control
    """Control of the task."""
    images: Mapping[str, ImageSpec]
    """Declarations of the images that the environment observes, by key."""
    actions: CloseLoopActions | OpenLoopActions
    """The action vector."""
    total_updates: int
    """Gradient updates of the run, the length of schedules."""
    seed: int
    device: torch.device
    pretrain_updates: int = 0
    """The first of `total_updates`, before the first collection."""

    def derived_seed(self, use: SeedUse) -> int:
        """Return the run's seed for one use of randomness."""
        return derive_seed(self.seed, use)


class Algorithm(ABC):
    """Learns from transitions, which `ba_torchrl.training.experiment` collects."""

    policy: TensorDictModuleBase
    """From a root TensorDict of any batch shape to ``action``; explores under TorchRL's
    exploration type RANDOM and is greedy under DETERMINISTIC."""
    updates: int = 0
    """Gradient updates so far."""

    def nearest_action(self, action: Tensor) -> Tensor:
        """Return the action nearest to a given one among those that the policy can choose.

        Demonstrations execute this action, so that the executed action is the one that is learnt.
        By default the policy can choose every action.

        Args:
            action: [..., A].
        """
        return action

    @abstractmethod
    def to_transitions(self, data: TensorDictBase, *, is_demonstration: bool) -> TensorDictBase:
        """Return collected data as the transitions [N] that the replay stores.

        Args:
            data: steps of any batch shape, those of an episode in order.
            is_demonstration: whether they are demonstrations.
        """

    def on_demonstrations(self, episodes: Sequence[TensorDictBase]) -> None:
        """Process the demonstrations before the first update; by default they enter the replay.

        Args:
            episodes: TensorDicts [T].
        """
        for episode in episodes:
            self.extend(self.to_transitions(episode, is_demonstration=True))

    @abstractmethod
    def extend(self, transitions: TensorDictBase) -> None:
        """Add transitions [N] to the replay, except those with a fault."""

    @property
    @abstractmethod
    def replay_size(self) -> int:
        """Number of transitions in the replay."""

    def compile(self, mode: CompileMode) -> None:
        """Compile the updates with `torch.compile`; by default not possible.

        An algorithm that implements this sets `AlgorithmConfig.is_compilable`.

        Args:
            mode: of `torch.compile`.

        Raises:
            ConfigError: the algorithm cannot be compiled, the mode is unknown, or the system has no
                compiler.
        """
        raise ConfigError("compile_mode: this algorithm cannot be compiled; leave it out")

    @abstractmethod
    def update(self) -> TensorDict:
        """Sample a batch, take one gradient step and return scalars without gradient, all on one
        device.

        Raises:
            FloatingPointError: a loss is not finite.
        """

    def pretrain_update(self) -> TensorDict:
        """Take one update before the first collection; by default `update`.

        An override increments `updates`, and returns and raises as `update` does.
        """
        return self.update()

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return networks, optimiser, counters and generators."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore networks, optimiser, counters and generators from a `state_dict`."""

    @abstractmethod
    def save_replay(self, folder: Path) -> None:
        """Write the replay into a folder: transitions, priorities and the state of its draws.

        Args:
            folder: an empty folder.
        """

    @abstractmethod
    def load_replay(self, folder: Path) -> None:
        """Restore the replay from a folder that `save_replay` wrote.

        Args:
            folder: the folder; it may be deleted after the call.
        """


class AlgorithmConfig(StrictModel, ABC):
    """Hyper-parameters of an algorithm, from which it is built for a network and a problem."""

    controls: ClassVar[frozenset[Control]]
    """Controls of the tasks that the algorithm supports."""
    collects: ClassVar[bool] = True
    """Whether the policy collects transitions; if not, all updates are on the demonstrations."""
    is_compilable: ClassVar[bool] = False
    """Whether `Algorithm.compile` is possible."""

    @property
    def pretraining_option(self) -> str | None:
        """The option and its value that only affect updates before the first collection, which
        the run must then have; None if there is none."""
        return None

    @property
    def replay_capacity(self) -> int | None:
        """Number of transitions that fit the replay, demonstrations included; None without a
        limit."""
        return None

    def check(self, network: NetworkConfig, control: Control) -> None:
        """Check that the algorithm supports the task's control, and that the network does.

        Args:
            network: hyper-parameters of the network.
            control: control of the task.

        Raises:
            ConfigError: the algorithm or the network does not support this control.
        """
        if control not in self.controls:
            known = [name for name in ALGORITHMS if control in ALGORITHMS[name].controls]
            raise ConfigError(
                f"algorithm {ALGORITHMS.name_of(type(self))!r} learns "
                f"{' and '.join(sorted(self.controls))} tasks, not {control} ones; {control} tasks "
                f"take algorithm: {', '.join(known)}"
            )
        if network.control != control:
            known = [name for name in NETWORKS if NETWORKS[name].control == control]
            raise ConfigError(
                f"network {NETWORKS.name_of(type(network))!r} is for {network.control} tasks; "
                f"{control} tasks take network: {', '.join(known)}"
            )

    def without_effect(self, network: NetworkConfig) -> Iterator[str]:
        """Yield a message for each value that has no effect together with the others.

        Args:
            network: hyper-parameters of the network.
        """
        yield from ()

    @abstractmethod
    def build(self, network: NetworkConfig, problem: Problem) -> Algorithm:
        """Return a freshly initialised algorithm."""
