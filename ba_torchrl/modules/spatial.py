"""What a network with spatial Q values is: one value per pixel, and per angle where it has any."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

from torch import Tensor, nn


@dataclass(frozen=True)
class SpatialSpec:
    """The shapes that an open-loop task hands to a network.

    Args:
        image_size: height and width of the heightmap, pixels.
        in_hand_size: height and width of the in-hand image, pixels.
        in_hand_channels: its channels: 1 for "raw" and "sub", 3 for "proj".
        components: of the action without its primitive, in the order of the action: some of x, y,
            z, rz, ry, rx.
        half_rotation: yaws half a turn apart are the same.

    Raises:
        ValueError: a size is not positive, or x or y is missing.
    """

    image_size: int
    in_hand_size: int
    in_hand_channels: int
    components: tuple[str, ...]
    half_rotation: bool = True

    def __post_init__(self) -> None:
        if min(self.image_size, self.in_hand_size, self.in_hand_channels) < 1:
            raise ValueError(f"sizes must be positive, got {self}")
        if not {"x", "y"} <= set(self.components):
            raise ValueError(f"the action needs x and y, got {self.components}")


class Level(NamedTuple):
    """One decision of a policy: components of the action that are chosen together.

    Fields:
        components: their names in the order of the axes of the Q values: x (rows of the image),
            y (columns), z, rz, ry, rx.
        shape: number of choices along each axis.
    """

    components: tuple[str, ...]
    shape: tuple[int, ...]


class SpatialQNetwork(nn.Module, ABC):
    """Q values of an action that is chosen level by level, each level knowing the ones before.

    Which primitive it is, pick or place, is not chosen: an open hand picks, a full one places, and
    the values are those of that primitive.
    """

    levels: tuple[Level, ...]

    @abstractmethod
    def first(self, pixels: Tensor, in_hand: Tensor, holding: Tensor) -> tuple[Tensor, Any]:
        """Return the Q values of the first level, and what the later ones need besides.

        Args:
            pixels: heightmaps [B, 1, H, W], metres.
            in_hand: images of what is held [B, C, h, w].
            holding: [B, 1], true where something is held.

        Returns:
            float32 [B, *levels[0].shape], and an opaque state for `later`.
        """

    def later(self, level: int, state: Any, chosen: Tensor) -> Tensor:
        """Return the Q values of a later level.

        Args:
            level: its number, at least 1.
            state: from `first`.
            chosen: int64 [B, n], indices of the components chosen so far, level after level.

        Returns:
            float32 [B, *levels[level].shape].
        """
        raise NotImplementedError(f"{type(self).__name__} has one level")
