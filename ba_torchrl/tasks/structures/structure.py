"""The pieces of a blueprint as bodies of a world."""

from __future__ import annotations

import numpy as np

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.structures.assignment import SlotAssigner, read_piece_states
from ba_torchrl.tasks.structures.blueprint import Blueprint, Piece
from ba_torchrl.tasks.structures.variants import PieceVariants
from ba_torchrl.tasks.terrain.flat import Terrain


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
        self._variants = PieceVariants(blueprint, world)
        self._update()

    def draw(self, rng: np.random.Generator) -> None:
        """Draw the variants of an episode and activate them."""
        self._variants.draw(rng)
        self._update()

    def assigner(self, held: Body | None) -> SlotAssigner:
        """Return the assigner for the present states of the pieces."""
        ground, base = self.terrain.support_ids, self.terrain.base_ids
        states = read_piece_states(self.world, self.pieces, ground, base, self.block_m)
        return SlotAssigner(self.blueprint, self.pieces, states, self.block_m, held)

    def get_state(self) -> tuple[int, ...]:
        """Return the indices of the active variants."""
        return self._variants.pool.get_state()

    def set_state(self, state: tuple[int, ...]) -> None:
        """Activate variants by their indices; the world restores poses and visibility."""
        self._variants.pool.set_state(state)
        self._update()

    def _update(self) -> None:
        """Set the pieces after a change of the active variants."""
        self.pieces: dict[Body, Piece] = {**self._fixed, **self._variants.active()}
        """The bodies in the scene, in the order in which they are placed."""
