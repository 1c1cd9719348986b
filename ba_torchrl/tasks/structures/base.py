"""The goal of the tasks that build a structure."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

from ba_torchrl.sim.bodies import Body
from ba_torchrl.tasks.base import Task
from ba_torchrl.tasks.instructions import structure_instruction
from ba_torchrl.tasks.structures.blueprint import UPRIGHT_RAD, Blueprint
from ba_torchrl.tasks.structures.progress import structure_progress
from ba_torchrl.tasks.structures.structure import Structure


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
