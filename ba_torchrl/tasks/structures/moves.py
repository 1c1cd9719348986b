"""Moves of pieces, and what the planner asks about their grasps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.geometry import IDENTITY, Quaternion, Vector
from ba_torchrl.tasks.structures.blueprint import Piece

DEFICIT_WEIGHT = 10.0
"""Cost of a metre of missing clearance, as a multiple of the cost of a metre of distance."""


class Choice(NamedTuple):
    """A piece that can be moved next."""

    removals: int
    """Pieces to place on the ground before a slot can be filled, this one included."""
    body: Body
    slot: int | None = None
    """Number of the slot that it fills; None for the ground."""


class Move(NamedTuple):
    """A piece to pick, and where to place it."""

    body: Body
    piece: Piece
    position: Vector
    """Final position of its origin."""
    yaw_rad: float | None
    """Final yaw up to multiples of the period; None if any yaw is allowed."""
    yaw_period_rad: float
    onto: tuple[Body, ...] = ()
    """The bodies that will support it; empty for the ground."""
    surface: Quaternion = IDENTITY
    """Orientation of a frame whose z axis is the normal of the surface that will support it."""
    deficit_m: float = 0.0
    """Free space that this and the following moves lack there."""


class Grasps:
    """The grasps of the pieces in the present scene; by default every grasp is free."""

    clears_blocked_pieces: bool = False
    """Whether pieces that block the grasp of another piece are removed."""

    def rise_m(self, body: Body) -> float:
        """Return the height of a piece's origin above its support when it is released."""
        return body.position[2] - vertical_extent(body)[0]

    def pick_cost_m(self, body: Body) -> float:
        """Return the cost of picking a piece, a distance that is added to the move's distance."""
        return 0.0

    def site_deficit_m(self, sites: np.ndarray, rest: Sequence[Body]) -> np.ndarray:
        """Return the clearance [S] that structures at sites lack for picking the remaining pieces.

        Args:
            sites: [S, P, 2] points of the ground that a structure at each site occupies, metres.
            rest: the pieces that remain to be picked.
        """
        return np.zeros(len(sites))

    def blocks_grasp(self, body: Body, other: Body, position: Vector | None) -> Sequence[bool]:
        """Return for each grasp of a piece whether another piece blocks it.

        Args:
            position: assumed position of the other piece; its present one if None.
        """
        return (False,)
