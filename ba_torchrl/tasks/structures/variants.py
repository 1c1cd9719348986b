"""Pieces whose shape varies between episodes.

No bodies can be added to a sealed world. All variants of a kind of piece are therefore loaded, and
every episode activates as many as there are slots.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.structures.blueprint import Blueprint, Piece


class _Kind(NamedTuple):
    """The variants of one kind of piece."""

    pieces: tuple[Piece, ...]
    count: int
    """Number of slots that they fill."""
    first: int
    """Index of the first variant in the pool."""


class PieceVariants:
    """The variants of the pieces of a blueprint; a blueprint without variants has none.

    Args:
        world: not sealed yet.
    """

    def __init__(self, blueprint: Blueprint, world: World) -> None:
        self._kinds: list[_Kind] = []
        self._pieces: list[Piece] = []
        for piece in dict.fromkeys(slot.piece for slot in blueprint.slots):
            if piece.variants:
                count = sum(slot.piece == piece for slot in blueprint.slots)
                self._kinds.append(_Kind(piece.variants, count, len(self._pieces)))
                self._pieces += piece.variants
        self.pool = BodyPool(
            world,
            [piece.shape for piece in self._pieces],
            [f"{piece.kind} variant {i + 1}" for i, piece in enumerate(self._pieces)],
        )
        self._activate(kind.first + i for kind in self._kinds for i in range(kind.count))

    def draw(self, rng: np.random.Generator) -> None:
        """Draw the variants of an episode and activate them."""
        chosen: list[int] = []
        for pieces, count, first in self._kinds:
            if count == 1:
                chosen.append(first + int(rng.integers(len(pieces))))
            else:
                drawn = rng.choice(len(pieces), size=count, replace=False)
                chosen += (first + drawn).tolist()
        self._activate(chosen)

    def active(self) -> dict[Body, Piece]:
        """Return the active variants."""
        bodies = self.pool.bodies
        return {body: self._pieces[bodies.index(body)] for body in self.pool.active}

    def _activate(self, indices: Iterable[int]) -> None:
        """Activate these variants and deactivate all others."""
        if self.pool.bodies:
            self.pool.clear()
        for index in indices:
            self.pool.activate(self.pool.bodies[index])
