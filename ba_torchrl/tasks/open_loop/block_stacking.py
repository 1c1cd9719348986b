"""Block Stacking: put blocks on top of each other (appendix A.1)."""

from __future__ import annotations

from collections.abc import Sequence

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.open_loop.pieces import cube
from ba_torchrl.tasks.open_loop.structure import Part, StructureTask
from ba_torchrl.tasks.structures import CUBE, Blueprint, tower


@TASKS.register("open_loop/block_stacking")
class BlockStacking(StructureTask):
    """Cubes of 3 cm, four unless told otherwise; success when they stand in a stack."""

    max_steps = 10
    num_objects = 4
    num_objects_range = (2, 8)

    def blueprint(self) -> Blueprint:
        """Return the stack."""
        return tower(*[CUBE] * self.settings.num_objects)

    def parts(self) -> Sequence[Part]:
        """Return the cubes."""
        return [cube(self.block_m)] * self.settings.num_objects
