"""House Building 2: a roof on two blocks (appendix A.1)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, Slot
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.parts import cube, pair_span, roof


class House2:
    """Mixin of a `StructureTask`: House Building 2 on any terrain."""

    max_steps = 10
    num_objects = 3
    num_objects_range = (3, 3)

    def blueprint(self) -> Blueprint:
        """Return two cubes that support the roof."""
        block = cube(self.block_m)
        across = Slot(roof(self.block_m), on=(0, 1), span=pair_span(self.block_m, 2.0))
        return Blueprint((Slot(block), Slot(block), across))


@TASKS.register("open_loop/house_building_2")
class HouseBuilding2(House2, StructureTask):
    """Objects: two cubes of 3 cm and a roof of 3 x 12 x 3 cm.

    Goal: the roof lies on both cubes, released. The episode ends early when the roof tips over or a
    piece leaves the workspace. Appendix A.1.
    """
