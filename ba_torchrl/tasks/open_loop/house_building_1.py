"""House Building 1: a stack of blocks with a triangle on top (appendix A.1)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, tower
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.parts import cube, triangle


class House1:
    """Mixin of a `StructureTask`: House Building 1 on any terrain."""

    max_steps = 10
    num_objects = 4
    num_objects_range = (2, 6)

    def blueprint(self) -> Blueprint:
        """Return the stack with the triangle."""
        cubes = [cube(self.block_m)] * (self.settings.num_objects - 1)
        return tower(*cubes, triangle(self.block_m))


@TASKS.register("open_loop/house_building_1")
class HouseBuilding1(House1, StructureTask):
    """Objects: one to five cubes of 3 cm, three by default, and a triangle of 3 cm.

    Goal: the cubes form a stack with the triangle on top, released. The episode ends early when the
    triangle tips over or a piece leaves the workspace. Appendix A.1.
    """
