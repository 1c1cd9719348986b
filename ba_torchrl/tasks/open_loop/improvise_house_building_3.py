"""Improvise House Building 3: a random cuboid and a roof on two random shapes (appendix A.1)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, Slot
from ba_torchrl.tasks.structures.improvise import (
    START_GAP_M,
    any_cuboid,
    any_shape,
    shape_span,
    with_circular_spacing,
)
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.parts import roof


class ImprovisedHouse3:
    """Mixin of a `StructureTask`: Improvise House Building 3 on any terrain."""

    scale_limits = (0.55, 0.9)
    max_steps = 10
    num_objects = 4
    num_objects_range = (4, 4)
    start_gap_m = START_GAP_M
    least_pick_blocks = 0.0

    def blueprint(self) -> Blueprint:
        """Return two shapes that support the cuboid, which supports the roof."""
        shape = any_shape()
        return Blueprint(
            (
                Slot(shape),
                Slot(shape),
                Slot(any_cuboid(), on=(0, 1), span=shape_span()),
                Slot(with_circular_spacing(roof(self.block_m)), on=(2,), centered_over=(0, 1)),
            )
        )


@TASKS.register("open_loop/improvise_house_building_3")
class ImproviseHouseBuilding3(ImprovisedHouse3, StructureTask):
    """Objects: two random shapes, 2.5 to 3 cm high, a random cuboid and a roof of 3 x 12 x 3 cm.

    Goal: the cuboid lies on both shapes and the roof on the cuboid, both centred over the shapes,
    released. The episode ends early when a shape or the roof tips over, or a piece leaves the
    workspace. Appendix A.1.
    """
