"""The base of the tasks that build a structure with picks and places."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import ClassVar

import numpy as np

from ba_torchrl.core.actions import PickPlaceCommand
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.sim.bodies import Body, footprint_radius_m
from ba_torchrl.tasks.base import TASKS, OpenLoopTask
from ba_torchrl.tasks.structures.base import StructureGoal
from ba_torchrl.tasks.structures.blueprint import Piece
from ba_torchrl.tasks.structures.pick_place_expert import PickPlaceExpert
from ba_torchrl.tasks.structures.piece_grasps import PickPlaceGrasps
from ba_torchrl.tasks.structures.structure import Structure
from ba_torchrl.tasks.workspace import Spacing

WINDOW_SHARE = 0.375
"""Half the width of the window for a long piece, as a multiple of its length."""


class StructureTask(StructureGoal, OpenLoopTask):
    """A structure in open loop."""

    max_steps = 10
    clears_blocked_pieces: ClassVar[bool] = False
    """Whether the expert removes pieces that block the grasp of another piece. Off for structures
    with long pieces, for which the removals would not end."""
    start_gap_m: ClassVar[float] = 0.01
    """Least gap between the bounding circles of two pieces at the start, metres."""
    least_pick_blocks: ClassVar[float] = 0.5
    """Least height of a pick above the ground in blocks, for actions without z. The heightmap
    underestimates a ridge between two pixels, and fingers reach lower as they close."""

    def load_scene(self) -> None:
        """Load the pieces."""
        self.structure = Structure(self.blueprint(), self.world, self.block_m, self.terrain)
        slots = self.structure.blueprint.slots
        self._reserve(piece for slot in slots for piece in slot.piece.variants or (slot.piece,))

    def grasps(self) -> PickPlaceGrasps:
        """Return the grasps of the pieces in the present scene."""
        return PickPlaceGrasps(
            self.structure,
            self.robot,
            self.action_limits,
            finger_opening=self.finger_opening,
            clears_blocked_pieces=self.clears_blocked_pieces,
        )

    def choose_objects(self, rng: np.random.Generator) -> None:
        """Draw the variants of the pieces."""
        self.structure.draw(rng)
        self._reserve(self.structure.pieces.values())

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place the pieces at random poses, apart from each other.

        With fixed orientations, a gripper at yaw 0 can grasp each of them. On a terrain that only
        supports a structure in a part of it, one piece of the lowest layer starts there.
        """
        pieces = self.structure.pieces
        lowest = self.structure.blueprint.slots[0].piece.kind
        self.terrain.scatter(
            rng,
            list(pieces),
            self._spacings(),
            lambda body: self.random_yaw(rng, 2 * math.pi) - pieces[body].grasp_yaws_rad[0],
            base=next(body for body, piece in pieces.items() if piece.kind == lowest),
        )

    def expert_command(self) -> PickPlaceCommand:
        """Return the pick or place of the planner's next move."""
        return next(PickPlaceExpert(self.grasps()).commands())

    def expert_moves(self) -> list[PickPlaceCommand]:
        """Return that command, then picks of pieces alike, or places in slots alike and at other
        yaws, that are as good."""
        return list(itertools.islice(PickPlaceExpert(self.grasps()).commands(), self.equal_moves))

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a pick without z, at least `least_pick_blocks`."""
        least_m = self.terrain.height_m(xy) + self.least_pick_blocks * self.block_m
        return max(super().pick_height_m(top_m, xy), least_m)

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the window that is searched for the highest point, metres.

        The supports of a long piece may be far from its centre. The window of a piece that always
        stands on the ground is small, so that neighbours do not raise its place.
        """
        if held is None or not self._rests_on_pieces(held):
            return super().window_m(held)
        low, high = held.shape.bounds_m
        longest = max(high[0] - low[0], high[1] - low[1])
        return max(super().window_m(held), WINDOW_SHARE * longest)

    def _reserve(self, pieces: Iterable[Piece]) -> None:
        """Leave space on the terrain for the widest of the pieces that stand on the ground."""
        slots = self.structure.blueprint.slots
        kinds = {slot.piece.kind for slot in slots if not slot.on}
        self.terrain.reserve(max(_grasped_width_m(p) for p in pieces if p.kind in kinds))

    def _spacings(self) -> list[Spacing]:
        """Return the space that each piece needs at the start of an episode."""
        spacings, largest_radius_m = [], 0.0
        for body, piece in self.structure.pieces.items():
            radius = footprint_radius_m(body)
            padding_m, distance_m = (2 * radius, 0.0) if piece.spacing is None else piece.spacing
            distance_m = max(distance_m, radius + largest_radius_m + self.start_gap_m)
            spacings.append(Spacing(padding_m, distance_m))
            largest_radius_m = max(largest_radius_m, radius)
        return spacings

    def _rests_on_pieces(self, body: Body) -> bool:
        """Whether a slot for this kind of piece is supported by other pieces."""
        kind = self.structure.pieces[body].kind
        return any(slot.on and slot.piece.kind == kind for slot in self.structure.blueprint.slots)


def _grasped_width_m(piece: Piece) -> float:
    """Return the extent of a piece between the fingers."""
    yaw = piece.grasp_yaws_rad[0]
    return float(np.ptp(piece.shape.vertices[:, :2] @ (math.cos(yaw), math.sin(yaw))))


def check_has_structure(task: str) -> None:
    """Raise `ConfigError` unless a task has a structure that can be taken apart."""
    if not issubclass(TASKS[task], StructureTask):
        possible = ", ".join(name for name in TASKS if issubclass(TASKS[name], StructureTask))
        raise ConfigError(f"deconstruction has no meaning for {task}; it is for {possible}")
