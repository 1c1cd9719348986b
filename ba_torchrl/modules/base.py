"""The interface of actor-critic networks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor, nn
from typing_extensions import Self

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.modules.config import NETWORKS, NetworkConfig

__all__ = ["NETWORKS", "ActorCritic", "ActorCriticSpec", "Frames", "NetworkConfig"]

ACTION_LETTERS = "pxyzr"
"""Close-loop action components: p gripper, x y z displacement, r yaw."""

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
"""Bounds of the policy's log standard deviation."""


@dataclass(frozen=True)
class ActorCriticSpec:
    """What an actor-critic network is built for: images, vectors and action.

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
        if keys.DEPTH not in self.images:
            found = list(self.images)
            raise ConfigError(f"images lack {keys.DEPTH!r}: {found}; SpatialSpec takes heightmaps")
        letters = self.action_sequence
        known = set(ACTION_LETTERS) if isinstance(letters, str) else set()
        if not letters or not known or len(set(letters)) != len(letters) or set(letters) - known:
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
    def image_shape(self) -> tuple[int, int, int]:
        """Shape [C, H, W] of ``depth``."""
        return self.image_channels, self.image_size, self.image_size

    @property
    def vector_size(self) -> int:
        """Length of all vector entries together."""
        return sum(self.vectors.values())

    @property
    def action_size(self) -> int:
        """Number of action components."""
        return len(self.action_sequence)


class Frames(NamedTuple):
    """How an encoder's features, and the action, move under the elements of a group.

    The features are fields with a component for each of the G elements, then V components of
    vectors.
    """

    action: Tensor
    """Representation on the action, [G, A, A], in the order of a field's components."""
    vectors: Tensor
    """Representation on the components of vectors, [G, V, V]."""

    @classmethod
    def without_symmetry(cls, spec: ActorCriticSpec) -> Self:
        """Return frames for features that do not move and end in the specification's vectors."""
        sizes = (spec.action_size, spec.vector_size)
        return cls(*(torch.eye(size, dtype=torch.float32, device="cpu")[None] for size in sizes))


@dataclass(frozen=True)
class ActorCritic:
    """Actor, encoder and critic of a Soft Actor-Critic, for any leading batch shape or none.

    Iterating over it gives the modules.
    """

    actor: nn.Module
    """(images [..., C, H, W] each, holding [..., 1], vectors [..., V] each) -> (loc [..., A],
    scale [..., A]) of the Gaussian before it is squashed."""
    encoder: nn.Module
    """(images, holding, vectors) -> features [..., F], shared by the two critics."""
    critic: nn.Module
    """(features [..., F], action [..., A]) -> twin values [..., 2], or [..., K] if the
    specification asks for K critics."""
    frames: Frames | None = None
    """What the features of `encoder` are, for heads that are equivariant as it is; None if they
    have no symmetry."""

    def __iter__(self) -> Iterator[nn.Module]:
        return iter((self.actor, self.encoder, self.critic))
