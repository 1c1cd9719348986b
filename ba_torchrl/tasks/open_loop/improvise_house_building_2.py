"""Improvise House Building 2: a roof on two random shapes (appendix A.1)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, Slot
from ba_torchrl.tasks.structures.improvise import START_GAP_M, any_shape, shape_span, spread
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.parts import roof


@TASKS.register("open_loop/improvise_house_building_2")
class ImproviseHouseBuilding2(StructureTask):
    """Two random shapes and a roof 12 cm long; success when it lies on both."""

    max_steps = 10
    num_objects = 3
    num_objects_range = (3, 3)
    start_gap_m = START_GAP_M
    least_pick_blocks = 0.0

    def blueprint(self) -> Blueprint:
        """Return two shapes with the roof across."""
        shape = any_shape()
        across = Slot(spread(roof(self.block_m)), on=(0, 1), span=shape_span())
        return Blueprint((Slot(shape), Slot(shape), across))
