"""House Building 4: two storeys of blocks, a cuboid between them, a roof (appendix A.1)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, Slot
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.parts import cube, cuboid, pair_span, roof


class House4:
    """Mixin of a `StructureTask`: House Building 4 on any terrain."""

    scale_limits = (0.55, 0.66)
    max_steps = 20
    num_objects = 6
    num_objects_range = (6, 6)

    def blueprint(self) -> Blueprint:
        """Return the two storeys and the roof."""
        block, span = cube(self.block_m), pair_span(self.block_m, 2.3)
        return Blueprint(
            (
                Slot(block),
                Slot(block),
                Slot(cuboid(self.block_m), on=(0, 1), span=span),
                Slot(block, on=(2,)),
                Slot(block, on=(2,)),
                Slot(roof(self.block_m), on=(3, 4), span=span),
            )
        )


@TASKS.register("open_loop/house_building_4")
class HouseBuilding4(House4, StructureTask):
    """Objects: four cubes of 3 cm, a cuboid and a roof of 3 x 12 x 3 cm.

    Goal: two cubes support the cuboid, which supports the other two cubes, which support the roof,
    released. The episode ends early when the roof tips over or a piece leaves the workspace.
    Appendix A.1.
    """
