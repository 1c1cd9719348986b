"""Block Stacking: put blocks on top of each other (appendix A.1)."""

from __future__ import annotations

from typing import Literal

from ba_torchrl.core.config import TaskParameters
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, tower
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.pieces import cube, cylinder

BLOCKS = {"cube": cube, "cylinder": cylinder}
"""Pieces by `object_type`."""


@TASKS.register("open_loop/block_stacking")
class BlockStacking(StructureTask):
    """Objects: two to eight cubes or cylinders of 3 cm, four by default.

    Goal: the blocks form a stack, and none is held. The episode ends early when a cylinder tips
    over or a block leaves the workspace. Paper, appendix A.1.
    """

    class Parameters(TaskParameters):
        """The shape of the blocks."""

        object_type: Literal["cube", "cylinder"] = "cube"
        """Shape of all blocks."""

    num_objects = 4
    num_objects_range = (2, 8)
    clears_blocked_pieces = True

    @classmethod
    def step_limit(cls, num_objects: int) -> int:
        """Return 10, or the optimal number of steps if that is larger."""
        return max(cls.max_steps, 2 * (num_objects - 1))

    def blueprint(self) -> Blueprint:
        """Return the stack."""
        block = BLOCKS[self.settings.parameters.object_type](self.block_m)
        return tower(*[block] * self.settings.num_objects)
