"""The default launcher: processes of this machine."""

from __future__ import annotations

from pathlib import Path

from ba_torchrl.training.grid import jobs
from ba_torchrl.training.grid.launchers.base import Grid
from ba_torchrl.training.grid.launchers.local_config import LocalConfig


def run_all(_: LocalConfig, grid: Grid) -> dict[Path, str]:
    """Run the unfinished runs; see `LauncherConfig.run_all`."""
    return jobs.run_all(grid.runs, jobs=grid.jobs, max_hours=grid.max_hours)
