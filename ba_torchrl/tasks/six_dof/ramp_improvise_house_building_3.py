"""Improvise House Building 3 with ramps (appendix C)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.open_loop.improvise_house_building_3 import ImprovisedHouse3
from ba_torchrl.tasks.ramps import OnRamps
from ba_torchrl.tasks.structures.open_loop import StructureTask


@TASKS.register("ramp/improvise_house_building_3")
class RampImproviseHouseBuilding3(OnRamps, ImprovisedHouse3, StructureTask):
    """Improvise House Building 3 with two ramps: the structure stands between them.

    The distance between the ramps is 4 to 20 cm, and at least what the shapes of the episode need
    (4.4 to 7.8 cm). The slopes are 0 to 30 degrees, the heights of the lower edges 0 to 1 cm. The
    episode ends early when a shape or the roof lies on its side or a piece leaves the workspace.
    Appendix C.
    """
