"""Interface of the launchers, and their registry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import ClassVar

from ba_torchrl.core.config import StrictModel
from ba_torchrl.core.registry import Registry
from ba_torchrl.training.config import ExperimentConfig


@dataclass(frozen=True)
class Grid:
    """The runs of a benchmark and their limits."""

    runs: Sequence[ExperimentConfig]
    """All runs, from `plan`."""
    folder: Path
    """Of all runs."""
    jobs: int
    """Runs at the same time."""
    max_hours: float | None
    """Time limit of each run."""


class LauncherConfig(StrictModel):
    """Options of a launcher.

    Its module imports no torch: this package's classes name in `runner` what runs the grid. Another
    one can override `run_all` instead.
    """

    runner: ClassVar[str]
    """The function that `run_all` imports and calls with the options and the grid, as
    "module:function"."""
    uses_jobs: ClassVar[bool] = False
    """Whether ``jobs`` runs take place at the same time."""

    def check(self, runs: Sequence[ExperimentConfig]) -> None:
        """Raise `ConfigError` unless the launcher can be used, before anything starts."""
        return

    def run_all(self, grid: Grid) -> dict[Path, str]:
        """Run the unfinished runs of a grid, resume the interrupted ones, and wait for their end.

        Returns:
            By run folder, the reason of its failure. Runs that another process runs are left to it.
        """
        return resolve_name(self.runner)(self, grid)


LAUNCHERS: Registry[type[LauncherConfig]] = Registry(
    "launcher", "ba_torchrl.training.grid.launchers", LauncherConfig, "_config"
)
