"""Improvise House Building 2: a roof on two random shapes (appendix A.1)."""

from __future__ import annotations

from collections.abc import Sequence

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import ROOF, Blueprint, Slot
from ba_torchrl.tasks.structures.improvise import SHAPE, ImproviseTask, shape_span
from ba_torchrl.tasks.structures.open_loop import Part
from ba_torchrl.tasks.structures.parts import roof


@TASKS.register("open_loop/improvise_house_building_2")
class ImproviseHouseBuilding2(ImproviseTask):
    """Two random shapes and a roof 12 cm long; success when it lies on both."""

    max_steps = 10
    num_objects = 3
    num_objects_range = (3, 3)

    def blueprint(self) -> Blueprint:
        """Return two shapes with the roof across."""
        return Blueprint((Slot(SHAPE), Slot(SHAPE), Slot(ROOF, on=(0, 1), span=shape_span())))

    def parts(self) -> Sequence[Part]:
        """Return the roof."""
        return [roof(self.block_m)]
