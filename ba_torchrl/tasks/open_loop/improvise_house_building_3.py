"""Improvise House Building 3: a random cuboid and a roof on two random shapes (appendix A.1)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, Slot
from ba_torchrl.tasks.structures.improvise import (
    START_GAP_M,
    any_cuboid,
    any_shape,
    shape_span,
    spread,
)
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.parts import roof


@TASKS.register("open_loop/improvise_house_building_3")
class ImproviseHouseBuilding3(StructureTask):
    """Two random shapes, a random cuboid and a roof 12 cm long; success when they stand.

    The cuboid lies across the shapes, the roof on the cuboid, both above the middle of the shapes.
    """

    scale_limits = (0.55, 0.9)
    max_steps = 10
    num_objects = 4
    num_objects_range = (4, 4)
    start_gap_m = START_GAP_M
    least_pick_blocks = 0.0

    def blueprint(self) -> Blueprint:
        """Return two shapes with cuboid and roof across."""
        shape = any_shape()
        return Blueprint(
            (
                Slot(shape),
                Slot(shape),
                Slot(any_cuboid(), on=(0, 1), span=shape_span()),
                Slot(spread(roof(self.block_m)), on=(2,), over=(0, 1)),
            )
        )
