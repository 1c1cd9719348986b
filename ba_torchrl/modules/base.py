"""The interface of actor-critic networks, and the registry of networks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple

from torch import nn

from ba_torchrl.core import keys
from ba_torchrl.core.config import StrictModel
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.core.registry import Registry

Control = Literal["open_loop", "close_loop"]

ACTION_LETTERS = "pxyzr"
"""Close-loop action components: p gripper, x y z displacement, r yaw."""

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
"""Bounds of the policy's log standard deviation."""


@dataclass(frozen=True)
class ActorCriticSpec:
    """Images and actions that an actor-critic network is built for.

    Args:
        images: declarations of the network's input images, by key, in the order of its arguments.
        action_sequence: one letter per action component, in the order of the action ("pxyzr").
        critics: number of critics of an ensemble with layer normalisation, see
            `ba_torchrl.modules.actor_critic.critics`; None for twin critics without it.
        vectors: length of each vector entry of the observation that the network sees, by key, in
            the order of its arguments after the holding flag.
        center_m: x and y of the workspace's centre, about which the scene rotates.
    """

    images: Mapping[str, ImageSpec]
    action_sequence: str
    critics: int | None = None
    vectors: Mapping[str, int] = field(default_factory=dict)
    center_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        letters = self.action_sequence
        if not letters or len(set(letters)) != len(letters) or set(letters) - set(ACTION_LETTERS):
            raise ValueError(
                f"action_sequence must hold different letters of {ACTION_LETTERS!r}, "
                f"got {letters!r}"
            )

    @property
    def image_size(self) -> int:
        """Rows and columns of ``depth``."""
        return self.images[keys.DEPTH].size

    @property
    def image_channels(self) -> int:
        """Channels of ``depth``."""
        return self.images[keys.DEPTH].channels

    @property
    def vector_size(self) -> int:
        """Length of all vector entries together."""
        return sum(self.vectors.values())

    @property
    def action_size(self) -> int:
        """Number of action components."""
        return len(self.action_sequence)


class ActorCritic(NamedTuple):
    """The three plain modules of a Soft Actor-Critic, for any leading batch shape, even none."""

    actor: nn.Module
    """(images [..., C, H, W] each, holding [..., 1], vectors [..., V] each) -> (loc [..., A],
    scale [..., A]) of the Gaussian before it is squashed."""
    encoder: nn.Module
    """(images, holding, vectors) -> features [..., F], shared by the two critics."""
    critic: nn.Module
    """(features [..., F], action [..., A]) -> twin values [..., 2], or [..., K] if the
    specification asks for K critics."""


class NetworkConfig(StrictModel, ABC):
    """A registered network: its hyper-parameters, and how it is built."""

    control: ClassVar[Control]
    """Control of the tasks that it supports. ``build`` returns an `ActorCritic` for close-loop
    tasks and a `ba_torchrl.modules.spatial.base.SpatialQNetwork` for open-loop tasks."""
    image_keys: ClassVar[tuple[str, ...]]
    """Keys of its input images, in the order of its arguments; the holding flag follows."""
    vector_keys: ClassVar[Sequence[str]]
    """Keys of its input vectors, which follow the holding flag: a field, or of the class."""
    shares_encoder: ClassVar[bool] = False
    """Whether the policy sees features of the critics' encoder."""

    @abstractmethod
    def build(self, spec: Any) -> Any:
        """Return freshly initialised modules.

        Args:
            spec: images and action, an `ActorCriticSpec` or a `SpatialSpec`.

        Raises:
            ValueError: the network does not support the size or kind of an image or the components
                of the action, or they do not fit its hyper-parameters.
        """


NETWORKS: Registry[type[NetworkConfig]] = Registry("network", "ba_torchrl.modules", NetworkConfig)
