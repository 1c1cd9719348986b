"""Block Stacking: put blocks on top of each other (appendix A.1)."""

from __future__ import annotations

from collections.abc import Sequence

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, tower
from ba_torchrl.tasks.structures.open_loop import Part, StructureTask
from ba_torchrl.tasks.structures.parts import cube, cylinder

OBJECTS = {"cube": cube, "cylinder": cylinder}
"""What `object_type` may say."""


@TASKS.register("open_loop/block_stacking")
class BlockStacking(StructureTask):
    """Blocks of 3 cm, four unless told otherwise; success when they stand in a stack.

    They are cubes, or cylinders, of which none may tip over.
    """

    parameters = StructureTask.parameters | {"object_type"}
    max_steps = 10
    num_objects = 4
    num_objects_range = (2, 8)
    clears_blocked_pieces = True

    @classmethod
    def step_limit(cls, num_objects: int) -> int:
        """Return 10, or what the least number of picks and places takes if that is more."""
        return max(cls.max_steps, 2 * (num_objects - 1))

    def blueprint(self) -> Blueprint:
        """Return the stack."""
        return tower(*(part.piece for part in self.parts()))

    def parts(self) -> Sequence[Part]:
        """Return the blocks."""
        block = OBJECTS[self.settings.parameters["object_type"]]
        return [block(self.block_m)] * self.settings.num_objects
