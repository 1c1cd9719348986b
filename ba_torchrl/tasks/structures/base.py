"""The bases of the tasks that build a structure, in open loop and in close loop."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from ba_torchrl.actions import GripperCommand, PickPlaceCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.shapes import Color
from ba_torchrl.tasks.base import BLUE, GREEN, RED, CloseLoopTask, OpenLoopTask, Task
from ba_torchrl.tasks.structures.assignment import has_tipped
from ba_torchrl.tasks.structures.blueprint import UPRIGHT_RAD, Blueprint
from ba_torchrl.tasks.structures.experts import PickPlaceExpert, gripper_command
from ba_torchrl.tasks.structures.grasps import PickPlaceGrasps
from ba_torchrl.tasks.structures.structure import Structure
from ba_torchrl.tasks.workspace import Spacing

WINDOW_SHARE = 0.375
"""Half the width of the window for a long piece, as a multiple of its length."""
COLORS: tuple[Color, ...] = (RED, BLUE, (0.9, 0.6, 0.2, 1.0), GREEN)
"""Colors of the cubes in close loop, from the bottom up."""


class StructureGoal(Task):
    """A task whose goal is a structure of pieces that start at random poses on the ground.

    The episode ends when a piece that must stay upright tips over.
    """

    structure: Structure
    tipped_rad: ClassVar[float] = UPRIGHT_RAD
    """Tilt at which a piece that must stay upright, such as a roof, ends the episode."""

    @abstractmethod
    def blueprint(self) -> Blueprint:
        """Return the structure."""

    @property
    def objects(self) -> Sequence[Body]:
        """The pieces."""
        return list(self.structure.pieces)

    def get_state(self) -> Any:
        """Return the indices of the active variants of the pieces."""
        return self.structure.get_state()

    def set_state(self, state: Any) -> None:
        """Activate variants of the pieces by their indices."""
        self.structure.set_state(state)

    def evaluate(self) -> dict[str, bool]:
        """Return whether the structure stands and whether no piece is held."""
        return self.structure.assigner(self.robot.held_body()).evaluate()

    def is_valid(self) -> bool:
        """Whether all pieces are inside the workspace, and upright where required."""
        return super().is_valid() and not has_tipped(
            self.structure.pieces, self.robot.held_body(), self.tipped_rad
        )


class StructureTask(StructureGoal, OpenLoopTask):
    """A structure in open loop."""

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
        self.terrain.reserve(self.structure.widest_base_m(of_all=True))

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

    def expert_command(self) -> PickPlaceCommand:
        """Return the pick or place of the planner's next move."""
        return PickPlaceExpert(self.grasps()).command()

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
        kind = self.structure.pieces[body].kind
        return any(slot.on and slot.piece.kind == kind for slot in self.structure.blueprint.slots)


class CloseLoopStructureTask(StructureGoal, CloseLoopTask):
    """A structure in close loop."""

    spacing_blocks: ClassVar[dict[int, Spacing]] = {
        2: Spacing(2.4, 2.4),
        3: Spacing(2.4, 2.4),
        4: Spacing(1.6, 2.0),
    }
    """Space around each piece at the start, in blocks, by the number of pieces; that of the largest
    number also for more."""

    def load_scene(self) -> None:
        """Load the pieces."""
        self.structure = Structure(
            self.blueprint(),
            self.world,
            self.block_m,
            self.terrain,
            largest_first=False,
        )

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place the pieces at random poses, with clearance for the fingers.

        With fixed orientations, a gripper at yaw 0 can grasp each of them.
        """
        self.structure.draw(rng)
        pieces = self.structure.pieces
        spacings = self.spacing_blocks
        padding, distance = spacings.get(len(pieces), spacings[max(spacings)])
        spacing = Spacing(padding * self.block_m, distance * self.block_m)
        points = self.terrain.random_points(rng, [spacing] * len(pieces))
        for (body, piece), xy in zip(pieces.items(), points, strict=True):
            fixed_yaw = -piece.grasp_yaws_rad[0] % math.pi
            self.stand(body, xy, fixed_yaw + self.random_yaw(rng, piece.yaw_period_rad))

    def expert_command(self) -> GripperCommand:
        """Return the command of the planner's next move."""
        return gripper_command(self.structure, self.robot, self.action_limits)
