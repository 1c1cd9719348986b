"""Improvise House Building 2: a roof on two random shapes (appendix A.1)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, Slot
from ba_torchrl.tasks.structures.improvise import (
    START_GAP_M,
    any_shape,
    shape_span,
    with_circular_spacing,
)
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.parts import roof


class ImprovisedHouse2:
    """Mixin of a `StructureTask`: Improvise House Building 2 on any terrain."""

    max_steps = 10
    num_objects = 3
    num_objects_range = (3, 3)
    start_gap_m = START_GAP_M
    least_pick_blocks = 0.0

    def blueprint(self) -> Blueprint:
        """Return two shapes that support the roof."""
        shape = any_shape()
        across = Slot(with_circular_spacing(roof(self.block_m)), on=(0, 1), span=shape_span())
        return Blueprint((Slot(shape), Slot(shape), across))


@TASKS.register("open_loop/improvise_house_building_2")
class ImproviseHouseBuilding2(ImprovisedHouse2, StructureTask):
    """Objects: two random shapes, 2.5 to 3 cm high, and a roof of 3 x 12 x 3 cm.

    Goal: the roof lies on both shapes, released. The episode ends early when a shape or the roof
    tips over or leaves the workspace. Appendix A.1.
    """
