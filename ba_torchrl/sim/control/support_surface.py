"""The support surface, as far as picks and places depend on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from ba_torchrl.sim.geometry import Matrix
from ba_torchrl.sim.robots.gripper import Gripper


class SupportSurface(Protocol):
    """A surface above which the fingers close, and which the arm does not penetrate."""

    @property
    def support_ids(self) -> frozenset[int]:
        """PyBullet ids of the bodies that form the surface."""

    def lowest_tool_m(
        self,
        gripper: Gripper,
        xy: tuple[float, float],
        rotation: Matrix | None = None,
        opening: float = 1.0,
    ) -> float:
        """Return the least height of the tool at which the fingers close above the surface.

        Args:
            gripper: the gripper.
            xy: position of the tool, metres.
            rotation: rotation of the tool; None if it points down.
            opening: opening of the gripper before it closes, 0 to 1.
        """


@dataclass(frozen=True)
class Floor:
    """The horizontal floor at height zero.

    Args:
        floor_id: PyBullet's id of the floor.
    """

    floor_id: int

    @property
    def support_ids(self) -> frozenset[int]:
        """PyBullet id of the floor."""
        return frozenset((self.floor_id,))

    def lowest_tool_m(
        self,
        gripper: Gripper,
        xy: tuple[float, float],
        rotation: Matrix | None = None,
        opening: float = 1.0,
    ) -> float:
        """Return the least height of the tool; see `SupportSurface`."""
        return gripper.lowest_tool_m(rotation, opening)
