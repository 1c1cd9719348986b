"""What every actor-critic network is built from and built into, and the registry of networks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

from torch import nn

from ba_torchrl.registry import Registry

Control = Literal["open_loop", "close_loop"]

ACTION_LETTERS = "pxyzr"
"""Close-loop action components: p gripper, x y z displacement, r yaw."""

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
"""Bounds of the policy's log standard deviation."""


@dataclass(frozen=True)
class ActorCriticSpec:
    """The shapes that a task hands to a network.

    Args:
        image_size: height and width of the square image, pixels.
        action_sequence: one letter per action component, in the order of the action ("pxyzr").
        image_channels: channels of the image, the holding flag not counted.

    Raises:
        ValueError: the sequence is empty, repeats a letter or holds one outside "pxyzr"; a size
            is not positive.
    """

    image_size: int
    action_sequence: str
    image_channels: int = 1

    def __post_init__(self) -> None:
        letters = self.action_sequence
        if not letters or len(set(letters)) != len(letters) or set(letters) - set(ACTION_LETTERS):
            raise ValueError(
                f"action_sequence must hold different letters of {ACTION_LETTERS!r}, "
                f"got {letters!r}"
            )
        if self.image_size < 1 or self.image_channels < 1:
            raise ValueError(f"image_size and image_channels must be positive, got {self}")

    @property
    def action_size(self) -> int:
        """Number of action components."""
        return len(self.action_sequence)


class ActorCritic(NamedTuple):
    """The three plain modules of a Soft Actor-Critic, for any leading batch shape, none included.

    Fields:
        actor: (pixels [..., C, H, W] metres, holding [..., 1]) -> (loc [..., A], scale [..., A])
            of the Gaussian before its squashing.
        encoder: (pixels, holding) -> features [..., F], shared by the two critics.
        critic: (features [..., F], action [..., A]) -> twin values [..., 2].
    """

    actor: nn.Module
    encoder: nn.Module
    critic: nn.Module


class NetworkConfig(Protocol):
    """What a registered network is: a pydantic model of its hyper-parameters that can build."""

    control: ClassVar[Control]
    """Which tasks it is for: close-loop ones take an `ActorCritic`, open-loop ones a
    `ba_torchrl.modules.spatial.SpatialQNetwork`."""

    def build(self, spec: Any) -> Any:
        """Return freshly initialised modules for an `ActorCriticSpec`, or for a `SpatialSpec`."""
        ...


NETWORKS: Registry[type[NetworkConfig]] = Registry("network", "ba_torchrl.modules")
