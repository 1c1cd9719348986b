"""House Building 2: a roof on two blocks (appendix A.1)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, Slot
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.parts import cube, pair_span, roof


@TASKS.register("open_loop/house_building_2")
class HouseBuilding2(StructureTask):
    """Two cubes of 3 cm and a roof 12 cm long; success when it lies on both."""

    max_steps = 10
    num_objects = 3
    num_objects_range = (3, 3)

    def blueprint(self) -> Blueprint:
        """Return two cubes with the roof across."""
        block = cube(self.block_m)
        across = Slot(roof(self.block_m), on=(0, 1), span=pair_span(self.block_m, 2.0))
        return Blueprint((Slot(block), Slot(block), across))
