"""The pieces of a blueprint as bodies of a world, and whether they form the structure.

No bodies can be added to a sealed world. A kind of piece whose shape varies between episodes is
therefore loaded in all its variants, and every episode activates as many as there are slots.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.structures.assignment import SlotAssigner, read_piece_states
from ba_torchrl.tasks.structures.blueprint import Blueprint, Piece
from ba_torchrl.tasks.terrain.flat import Terrain


class _Variants(NamedTuple):
    """The variants of one kind of piece."""

    pieces: tuple[Piece, ...]
    count: int
    """Number of slots that they fill."""
    first: int
    """Index of the first variant in the pool."""


class Structure:
    """The pieces of a blueprint in a world.

    Args:
        blueprint: the structure; its pieces have shapes or variants.
        world: not sealed yet.
        largest_first: whether pieces are placed at random in order of the space that they need, the
            largest first; otherwise from the bottom slot up.
    """

    def __init__(
        self,
        blueprint: Blueprint,
        world: World,
        block_m: float,
        terrain: Terrain,
        *,
        largest_first: bool = True,
    ) -> None:
        self.blueprint = blueprint
        self.world = world
        self.block_m = block_m
        self.terrain = terrain
        pieces = [slot.piece for slot in blueprint.slots]
        if largest_first:
            pieces.reverse()
            pieces.sort(key=lambda p: p.spacing.distance_m if p.spacing else 0.0, reverse=True)
        self._fixed: dict[Body, Piece] = {}
        numbers: dict[str, int] = {}
        for piece in pieces:
            if not piece.variants:
                numbers[piece.kind] = numbers.get(piece.kind, 0) + 1
                body = world.add(piece.shape, f"{piece.kind} {numbers[piece.kind]}")
                self._fixed[body] = piece
        self._variants: list[_Variants] = []
        variants: list[Piece] = []
        for piece in dict.fromkeys(slot.piece for slot in blueprint.slots):
            if piece.variants:
                count = sum(slot.piece == piece for slot in blueprint.slots)
                self._variants.append(_Variants(piece.variants, count, len(variants)))
                variants += piece.variants
        self._pool = BodyPool(
            world,
            [piece.shape for piece in variants],
            [f"{piece.kind} variant {i + 1}" for i, piece in enumerate(variants)],
        )
        self._pool_pieces = variants
        self._activate([kind.first + i for kind in self._variants for i in range(kind.count)])

    def draw(self, rng: np.random.Generator) -> None:
        """Draw the variants of an episode and activate them."""
        chosen: list[int] = []
        for pieces, count, first in self._variants:
            if count == 1:
                chosen.append(first + int(rng.integers(len(pieces))))
            else:
                drawn = rng.choice(len(pieces), size=count, replace=False)
                chosen += (first + drawn).tolist()
        self._activate(chosen)

    def assigner(self, held: Body | None) -> SlotAssigner:
        """Return the assigner for the present states of the pieces."""
        ground, base = self.terrain.support_ids, self.terrain.base_ids
        states = read_piece_states(self.world, self.pieces, ground, base, self.block_m)
        return SlotAssigner(self.blueprint, self.pieces, states, self.block_m, held)

    def get_state(self) -> tuple[int, ...]:
        """Return the indices of the active variants."""
        return self._pool.get_state()

    def set_state(self, state: tuple[int, ...]) -> None:
        """Activate variants by their indices; the world restores poses and visibility."""
        self._pool.set_state(state)
        self._read_pool()

    def _activate(self, indices: Sequence[int]) -> None:
        """Activate these variants and deactivate all others."""
        if self._pool.bodies:
            self._pool.clear()
        for index in indices:
            self._pool.activate(self._pool.bodies[index])
        self._read_pool()

    def _read_pool(self) -> None:
        """Set the pieces after a change of the active variants."""
        drawn = {
            body: self._pool_pieces[self._pool.bodies.index(body)] for body in self._pool.active
        }
        self.pieces: dict[Body, Piece] = {**self._fixed, **drawn}
        """The bodies in the scene, in the order in which they are placed."""
