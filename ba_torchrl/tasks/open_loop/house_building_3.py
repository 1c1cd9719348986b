"""House Building 3: a cuboid and a roof on two blocks (appendix A.1)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, Slot
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.parts import cube, cuboid, pair_span, roof


class House3:
    """Mixin of a `StructureTask`: House Building 3 on any terrain."""

    scale_limits = (0.55, 0.9)
    max_steps = 10
    num_objects = 4
    num_objects_range = (4, 4)

    def blueprint(self) -> Blueprint:
        """Return two cubes that support the cuboid, which supports the roof."""
        block = cube(self.block_m)
        return Blueprint(
            (
                Slot(block),
                Slot(block),
                Slot(cuboid(self.block_m), on=(0, 1), span=pair_span(self.block_m, 2.2)),
                Slot(roof(self.block_m), on=(2,), centered_over=(0, 1)),
            )
        )


@TASKS.register("open_loop/house_building_3")
class HouseBuilding3(House3, StructureTask):
    """Objects: two cubes of 3 cm, a cuboid and a roof of 3 x 12 x 3 cm.

    Goal: the cuboid lies on both cubes and the roof on the cuboid, both centred over the cubes,
    released. The episode ends early when the roof tips over or a piece leaves the workspace.
    Appendix A.1.
    """
