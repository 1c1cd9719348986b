"""Block Stacking with ramps (appendix C)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.open_loop.block_stacking import StackedBlocks
from ba_torchrl.tasks.ramps import OnRamps
from ba_torchrl.tasks.structures.open_loop import StructureTask


@TASKS.register("ramp/block_stacking")
class RampBlockStacking(OnRamps, StackedBlocks, StructureTask):
    """Block Stacking with two ramps: the structure stands between them.

    The distance between the ramps is 4 to 20 cm, their slopes are 0 to 30 degrees, the heights of
    their lower edges 0 to 1 cm. The episode ends early when a piece leaves the workspace. Appendix
    C.
    """
