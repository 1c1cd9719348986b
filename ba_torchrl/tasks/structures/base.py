"""The bases of the tasks that build a structure, in open loop and in close loop."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

import numpy as np

from ba_torchrl.core.actions import GripperCommand, PickPlaceCommand
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.sim.bodies import Body, footprint_radius_m
from ba_torchrl.sim.shapes import Color
from ba_torchrl.tasks.base import BLUE, GREEN, RED, TASKS, CloseLoopTask, OpenLoopTask, Task
from ba_torchrl.tasks.instructions import structure_instruction
from ba_torchrl.tasks.structures.blueprint import UPRIGHT_RAD, Blueprint, Piece
from ba_torchrl.tasks.structures.experts import PickPlaceExpert, gripper_command
from ba_torchrl.tasks.structures.grasps import PickPlaceGrasps
from ba_torchrl.tasks.structures.progress import structure_progress
from ba_torchrl.tasks.structures.structure import Structure
from ba_torchrl.tasks.workspace import Spacing, random_points

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

    def instruction(self) -> str:
        """Return the instruction to build the structure of the blueprint."""
        bodies = [(piece.kind, body) for body, piece in self.structure.pieces.items()]
        words = structure_instruction(self.structure.blueprint, bodies)
        return words + self.terrain.place_words

    def progress(self) -> float:
        """Return the progress of the structure; see `structure_progress`."""
        moves_gradually = self.control == "close_loop"
        return structure_progress(self.structure, self.robot, moves_gradually=moves_gradually)

    def is_valid(self) -> bool:
        """Whether all pieces are inside the workspace, and upright where required."""
        held = self.robot.held_body()
        return super().is_valid() and not any(
            piece.stays_upright and body is not held and piece.tilt_rad(body) >= self.tipped_rad
            for body, piece in self.structure.pieces.items()
        )


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
        points = random_points(self.terrain.spawn_area, rng, [spacing] * len(pieces))
        for (body, piece), xy in zip(pieces.items(), points, strict=True):
            fixed_yaw = -piece.grasp_yaws_rad[0] % math.pi
            self.stand(body, xy, fixed_yaw + self.random_yaw(rng, piece.yaw_period_rad))

    def expert_command(self) -> GripperCommand:
        """Return the command of the planner's next move."""
        return gripper_command(self.structure, self.robot, self.action_limits)


def check_has_structure(task: str) -> None:
    """Check that a task has a structure that can be taken apart.

    Raises:
        ConfigError: it has none.
    """
    if not issubclass(TASKS[task], StructureTask):
        possible = ", ".join(name for name in TASKS if issubclass(TASKS[name], StructureTask))
        raise ConfigError(f"deconstruction has no meaning for {task}; it is for {possible}")
