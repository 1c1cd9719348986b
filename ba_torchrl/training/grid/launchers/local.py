"""The default launcher: processes of this machine."""

from __future__ import annotations

from pathlib import Path

from ba_torchrl.training.grid.jobs import run_all
from ba_torchrl.training.grid.launchers.base import LAUNCHERS, Grid, LauncherConfig


@LAUNCHERS.register("local")
class LocalConfig(LauncherConfig):
    """One process of this machine for each run, ``jobs`` of them at the same time."""

    uses_jobs = True

    def run_all(self, grid: Grid) -> dict[Path, str]:
        """Run the unfinished runs; see `LauncherConfig.run_all`."""
        return run_all(grid.runs, jobs=grid.jobs, max_hours=grid.max_hours)
