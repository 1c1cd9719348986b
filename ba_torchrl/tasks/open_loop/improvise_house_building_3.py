"""Improvise House Building 3: a random cuboid and a roof on two random shapes (appendix A.1)."""

from __future__ import annotations

from collections.abc import Sequence

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import CUBOID, ROOF, Blueprint, Slot
from ba_torchrl.tasks.structures.improvise import SHAPE, ImproviseTask, shape_span
from ba_torchrl.tasks.structures.open_loop import Part
from ba_torchrl.tasks.structures.parts import roof


@TASKS.register("open_loop/improvise_house_building_3")
class ImproviseHouseBuilding3(ImproviseTask):
    """Two random shapes, a random cuboid and a roof 12 cm long; success when they stand.

    The cuboid lies across the shapes, the roof on the cuboid, both above the shapes' middle.
    """

    scale_limits = (0.55, 0.9)
    max_steps = 10
    num_objects = 4
    num_objects_range = (4, 4)
    has_cuboid = True

    def blueprint(self) -> Blueprint:
        """Return two shapes with cuboid and roof across."""
        return Blueprint(
            (
                Slot(SHAPE),
                Slot(SHAPE),
                Slot(CUBOID, on=(0, 1), span=shape_span()),
                Slot(ROOF, on=(2,), over=(0, 1)),
            )
        )

    def parts(self) -> Sequence[Part]:
        """Return the roof."""
        return [roof(self.block_m)]
