"""What open-loop and close-loop tasks with a structure have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.structures.planner import StructurePlanner
from ba_torchrl.tasks.structures.structure import Structure


class StructureGoal:
    """Mixin of a task whose goal is its `structure`: objects, state and conditions of success."""

    structure: Structure
    robot: Robot

    @property
    def planner(self) -> StructurePlanner:
        """The planner that compares the pieces with the blueprint."""
        return self.structure.planner

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
        return self.planner.evaluate(self.robot.held_body())
