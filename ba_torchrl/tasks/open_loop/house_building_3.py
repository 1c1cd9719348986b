"""House Building 3: a cuboid and a roof on two blocks (appendix A.1)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, Slot
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.parts import cube, cuboid, pair_span, roof


@TASKS.register("open_loop/house_building_3")
class HouseBuilding3(StructureTask):
    """Two cubes of 3 cm, a cuboid and a roof 12 cm long; success when roof, cuboid and cubes stand.

    The cuboid lies across the cubes, the roof on the cuboid, both above the middle of the cubes.
    """

    scale_limits = (0.55, 0.9)
    max_steps = 10
    num_objects = 4
    num_objects_range = (4, 4)

    def blueprint(self) -> Blueprint:
        """Return two cubes with cuboid and roof across."""
        block = cube(self.block_m)
        return Blueprint(
            (
                Slot(block),
                Slot(block),
                Slot(cuboid(self.block_m), on=(0, 1), span=pair_span(self.block_m, 2.2)),
                Slot(roof(self.block_m), on=(2,), over=(0, 1)),
            )
        )
