"""House Building 4 on a bumpy surface (appendix C)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.bumps import OnBumps
from ba_torchrl.tasks.open_loop.house_building_4 import House4
from ba_torchrl.tasks.structures.open_loop import StructureTask


@TASKS.register("bump/house_building_4")
class BumpHouseBuilding4(OnBumps, House4, StructureTask):
    """House Building 4 on a platform of 13 x 13 cm; the pieces start on a bumpy surface around it.

    The surface consists of nine pyramids with slopes of 0 to 15 degrees. The episode ends early
    when the roof lies on its side or a piece leaves the workspace. Appendix C.
    """

    platform_m = (0.13, 0.13)
