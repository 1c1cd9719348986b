"""Box Palletizing on a bumpy surface (appendix C)."""

from __future__ import annotations

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.bumps import OnBumps
from ba_torchrl.tasks.open_loop.box_palletizing import Palletizing
from ba_torchrl.tasks.packing.base import PackingTask


@TASKS.register("bump/box_palletizing")
class BumpBoxPalletizing(OnBumps, Palletizing, PackingTask):
    """Box Palletizing with the pallet on a platform; the boxes arrive on a bumpy surface around it.

    The surface consists of nine pyramids with slopes of 0 to 15 degrees. The episode ends early
    when a box leaves the workspace. Appendix C.
    """

    platform_m = (0.24, 0.2)
    scale_limits = (0.75, 0.9)  # boxes and gripper have no room beside a larger platform
