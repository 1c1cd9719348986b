"""A structure: a cuboid across two cubes."""

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, Slot
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.pieces import cube, cuboid, pair_span


@TASKS.register("mine/bridge")
class Bridge(StructureTask):
    """Two cubes of 3 cm and a cuboid of 12 cm; success when it lies on both."""

    num_objects = 3
    num_objects_range = (3, 3)

    def blueprint(self) -> Blueprint:
        """Return two cubes with the cuboid across."""
        block = cube(self.block_m)
        across = Slot(cuboid(self.block_m), on=(0, 1), span=pair_span(self.block_m, 2.2))
        return Blueprint((Slot(block), Slot(block), across))
