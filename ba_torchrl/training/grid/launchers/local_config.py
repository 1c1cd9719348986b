"""Options of the default launcher."""

from __future__ import annotations

from typing import ClassVar

from ba_torchrl.training.grid.launchers.base import LAUNCHERS, LauncherConfig


@LAUNCHERS.register("local")
class LocalConfig(LauncherConfig):
    """One process of this machine for each run, ``jobs`` of them at the same time."""

    runner: ClassVar[str] = "ba_torchrl.training.grid.launchers.local:run_all"
    uses_jobs: ClassVar[bool] = True
