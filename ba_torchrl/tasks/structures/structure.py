"""The pieces of a blueprint as bodies of a world."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.structures.assignment import SlotAssigner, read_piece_states
from ba_torchrl.tasks.structures.blueprint import Blueprint, Piece
from ba_torchrl.tasks.terrain.flat import Terrain


class Structure:
    """The pieces of a blueprint in a world.

    No bodies can be added to a sealed world. All variants of a kind of piece are therefore loaded,
    and every episode activates as many as there are slots.

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
        self._varied = Counter(piece for piece in pieces if piece.variants)
        """Number of slots of each kind of piece with variants."""
        self._variants = [variant for piece in self._varied for variant in piece.variants]
        if largest_first:
            pieces.reverse()
            pieces.sort(key=lambda p: p.spacing.distance_m if p.spacing else 0.0, reverse=True)
        self._fixed: dict[Body, Piece] = {}
        numbers: Counter[str] = Counter()
        for piece in pieces:
            if not piece.variants:
                numbers[piece.kind] += 1
                body = world.add(piece.shape, f"{piece.kind} {numbers[piece.kind]}")
                self._fixed[body] = piece
        names = [f"{piece.kind} variant {i + 1}" for i, piece in enumerate(self._variants)]
        self._pool = BodyPool(world, [piece.shape for piece in self._variants], names)
        self._activate(map(np.arange, self._varied.values()))

    def draw(self, rng: np.random.Generator) -> None:
        """Draw the variants of an episode and activate them."""
        self._activate(
            rng.choice(len(piece.variants), size=count, replace=False)
            if count > 1
            else rng.integers(len(piece.variants), size=1)
            for piece, count in self._varied.items()
        )

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
        active = {self._pool.bodies[i]: self._variants[i] for i in state}
        self.pieces: dict[Body, Piece] = {**self._fixed, **active}
        """The bodies in the scene, in the order in which they are placed."""

    def _activate(self, numbers: Iterable[np.ndarray]) -> None:
        """Bring variants of each kind into the scene by their numbers, and remove all others."""
        self._pool.clear()
        first, chosen = 0, []
        for piece, own in zip(self._varied, numbers, strict=True):
            chosen += (first + own).tolist()
            first += len(piece.variants)
        for index in chosen:
            self._pool.activate(self._pool.bodies[index])
        self.set_state(tuple(chosen))
