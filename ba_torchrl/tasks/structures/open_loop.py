"""Structures under open-loop control: the base of the tasks that build one."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import ClassVar

import numpy as np

from ba_torchrl.actions import PickPlaceCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.tasks.base import OpenLoopTask
from ba_torchrl.tasks.structures.blueprint import UPRIGHT_RAD, Blueprint
from ba_torchrl.tasks.structures.goal import StructureGoal
from ba_torchrl.tasks.structures.pick_place_expert import PickPlaceExpert
from ba_torchrl.tasks.structures.structure import Structure

WINDOW_SHARE = 0.375
"""Half the width of the window for a long piece, as a multiple of its length."""


class StructureTask(StructureGoal, OpenLoopTask):
    """Pieces at random poses on the ground; success when they form the blueprint's structure."""

    tipped_rad: ClassVar[float] = UPRIGHT_RAD
    """Tilt at which a piece that must stay upright, such as a roof, ends the episode."""
    clears_blocked_pieces: ClassVar[bool] = False
    """Whether the expert removes pieces that block the grasp of another piece. Off for structures
    with long pieces, for which the removals would not end."""
    start_gap_m: ClassVar[float] = 0.01
    """Least gap between the bounding circles of two pieces at the start, metres."""
    least_pick_blocks: ClassVar[float] = 0.5
    """Least height of a pick above the ground in blocks, for actions without z. The heightmap
    underestimates a ridge between two pixels, and fingers reach lower as they close."""

    @abstractmethod
    def blueprint(self) -> Blueprint:
        """Return the structure."""

    def load_scene(self) -> None:
        """Load the pieces."""
        self.structure = Structure(self.blueprint(), self.world, self.block_m, self.terrain)
        self.terrain.reserve(self.structure.widest_base_m(of_all=True))
        self.expert = PickPlaceExpert(
            self.structure,
            self.robot,
            self.terrain,
            self.action_limits,
            finger_opening=self.finger_opening,
            clears_blocked_pieces=self.clears_blocked_pieces,
        )

    def choose_objects(self, rng: np.random.Generator) -> None:
        """Draw the variants of the pieces."""
        self.structure.draw(rng)
        self.terrain.reserve(self.structure.widest_base_m())

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place the pieces at random poses, apart from each other.

        With fixed orientations, a gripper at yaw 0 can grasp each of them. On a terrain that only
        supports a structure in a part of it, one piece of the lowest layer starts there.
        """
        self.terrain.scatter(
            rng,
            list(self.structure.pieces),
            self.structure.spacings(self.start_gap_m),
            lambda body: self._random_yaw_of(body, rng),
            base=self.structure.base_body(),
        )

    def is_valid(self) -> bool:
        """Whether all pieces are inside the workspace, and upright where required."""
        if not super().is_valid():
            return False
        return not self.planner.has_tipped(self.robot.held_body(), self.tipped_rad)

    def expert_command(self) -> PickPlaceCommand:
        """Return the pick or place of the planner's next move."""
        return self.expert.command()

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

    def _random_yaw_of(self, body: Body, rng: np.random.Generator) -> float:
        """Return a random yaw of a piece; with fixed orientations, one for a gripper at yaw 0."""
        return self.random_yaw(rng, 2 * math.pi) - self.structure.pieces[body].grasp_yaws_rad[0]

    def _rests_on_pieces(self, body: Body) -> bool:
        """Whether a slot for this kind of piece is supported by other pieces."""
        kind = self.planner.pieces[body].kind
        return any(slot.on and slot.piece.kind == kind for slot in self.planner.blueprint.slots)
