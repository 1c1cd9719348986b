"""Block Stacking: put blocks on top of each other (appendix A.2)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, tower
from ba_torchrl.tasks.structures.close_loop import COLORS, CloseLoopStructureTask
from ba_torchrl.tasks.structures.pieces import cube


@TASKS.register("close_loop/block_stacking")
class BlockStacking(CloseLoopStructureTask):
    """Objects: two to four cubes of 5 cm, two by default.

    Goal: the cubes form a stack, and none is held. The episode ends early when a cube leaves the
    workspace. Paper, appendix A.2.
    """

    num_objects = 2
    num_objects_range = (2, 4)  # a stack of five takes more than 50 steps

    def blueprint(self) -> Blueprint:
        """Return the stack."""
        return tower(*(cube(self.block_m, color) for color in COLORS[: self.settings.num_objects]))
