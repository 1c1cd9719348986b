"""House Building: stack blocks and put a triangle on top (appendix A.2)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, tower
from ba_torchrl.tasks.structures.close_loop import COLORS, CloseLoopStructureTask
from ba_torchrl.tasks.structures.pieces import cube, triangle


@TASKS.register("close_loop/house_building")
class HouseBuilding(CloseLoopStructureTask):
    """Objects: one to three cubes of 5 cm, one by default, and a triangle of 5 cm.

    Goal: the cubes form a stack with the triangle on top, and nothing is held. The episode ends
    early when the triangle tips over or a piece leaves the workspace. Paper, appendix A.2.
    """

    num_objects = 2
    num_objects_range = (2, 4)

    def blueprint(self) -> Blueprint:
        """Return the stack with the triangle."""
        cubes = (cube(self.block_m, color) for color in COLORS[: self.settings.num_objects - 1])
        return tower(*cubes, triangle(self.block_m))
