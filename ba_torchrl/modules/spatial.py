"""The interface of spatial Q networks: one value per pixel, and per angle if the action has any."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

from torch import Tensor, nn

from ba_torchrl.envs import keys
from ba_torchrl.envs.images import ImageSpec


@dataclass(frozen=True)
class SpatialSpec:
    """Images and actions that a spatial Q network is built for.

    Args:
        images: declarations of the network's input images, by key, in the order of its arguments:
            the heightmap, the in-hand image (1 channel for "raw" and "sub", 3 for "proj"), others.
        components: components of the action except its primitive, in the order of the action: a
            subset of x, y, z, rz, ry, rx.
        half_rotation: whether yaws half a turn apart are equivalent.
        side_m: edge of the square workspace, which the heightmap covers.

    Raises:
        ValueError: x or y is missing.
    """

    images: Mapping[str, ImageSpec]
    components: tuple[str, ...]
    half_rotation: bool = True
    side_m: float = 0.4

    def __post_init__(self) -> None:
        if not {"x", "y"} <= set(self.components):
            raise ValueError(f"the action needs x and y, got {self.components}")

    @property
    def image_size(self) -> int:
        """Rows and columns of the heightmap."""
        return self.images[keys.PIXELS].size

    @property
    def pixel_m(self) -> float:
        """Edge of a pixel of the heightmap."""
        return self.side_m / self.image_size

    @property
    def in_hand_size(self) -> int:
        """Rows and columns of the in-hand image."""
        return self.images[keys.IN_HAND].size

    @property
    def in_hand_channels(self) -> int:
        """Channels of the in-hand image."""
        return self.images[keys.IN_HAND].channels


class Level(NamedTuple):
    """Components of the action that one maximisation chooses together.

    Fields:
        components: their names in the order of the axes of the Q values: x (rows of the image),
            y (columns), z, rz, ry, rx.
        shape: number of choices along each axis.
    """

    components: tuple[str, ...]
    shape: tuple[int, ...]


class SpatialQNetwork(nn.Module, ABC):
    """Q values of an action that is chosen level by level, each given the choices before it.

    The primitive is not chosen: an empty gripper picks, a gripper that holds an object places. The
    values are those of that primitive.
    """

    levels: tuple[Level, ...]
    limits: Mapping[str, tuple[float, float]] = MappingProxyType({})
    """First and last value on the grids of z (metres) and the tilts (radians); components without
    an entry span the range of the action."""

    @abstractmethod
    def first(self, pixels: Tensor, in_hand: Tensor, holding: Tensor) -> tuple[Tensor, Any]:
        """Return the Q values of the first level, and the state that `later` needs.

        Args:
            pixels: heightmaps [B, 1, H, W], metres.
            in_hand: images of what is held [B, C, h, w].
            holding: [B, 1], true where an object is held; follows all input images.

        Returns:
            float32 [B, *levels[0].shape], and a state of any type, None if there is one level.
        """

    def later(self, level: int, state: Any, chosen: Tensor) -> Tensor:
        """Return the Q values of a later level.

        Args:
            level: index of the level, at least 1.
            state: from `first`.
            chosen: int64 [B, n], indices of the components chosen so far, level after level.

        Returns:
            float32 [B, *levels[level].shape].
        """
        raise NotImplementedError(f"{type(self).__name__} has one level")
