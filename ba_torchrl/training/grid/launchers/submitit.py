"""The launcher on SLURM, through Hydra's launcher hydra-submitit-launcher."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from pydantic import Field
from tqdm import tqdm

from ba_torchrl.core.errors import ConfigError, install_command
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.grid.jobs import unfinished
from ba_torchrl.training.grid.launchers.base import LAUNCHERS, Grid, LauncherConfig
from ba_torchrl.training.grid.plan import status

_OWN_OPTION = re.compile(r"\+*launcher[.=]")
_MINUTES_TO_SAVE = 5


@LAUNCHERS.register("submitit")
class SubmititConfig(LauncherConfig):
    """One SLURM job for each run, in a job array of which ``jobs`` run at the same time.

    The benchmark's command is repeated as a multirun of Hydra, in which each job runs one run. All
    machines see the grid's folder and the working directory under the same path.
    """

    cluster: Literal["slurm", "local"] = "slurm"
    """Where submitit starts the jobs; "local" for a trial on this machine."""
    cpus: int = Field(default=2, ge=1)
    """CPU cores of each job."""
    gpus: int = Field(default=0, ge=0)
    """GPUs of each job."""
    memory_gb: int = Field(default=16, ge=1)
    """Memory of each job."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Further options of Hydra's launcher, such as ``partition`` and ``account``."""
    print_only: bool = False
    """Print the command of the multirun instead of running it."""

    def check(self, runs: Sequence[ExperimentConfig]) -> None:
        """Check that Hydra's launcher is installed.

        Raises:
            ConfigError: it is not.
        """
        if find_spec("submitit") is None:
            raise ConfigError(
                "launcher: 'submitit' needs a package that is not installed: "
                f"{install_command('hydra-submitit-launcher')}"
            )

    def run_all(self, grid: Grid) -> dict[Path, str]:
        """Run the unfinished runs; see `LauncherConfig.run_all`.

        Raises:
            ConfigError: the jobs cannot be submitted.
        """
        waiting = unfinished(grid.runs)
        if not waiting:
            return {}
        command = self.command(grid, waiting)
        if self.print_only:
            tqdm.write(shlex.join(command))
            return {}
        if subprocess.run(command, check=False).returncode:
            raise ConfigError("the jobs could not be submitted, or did not end; see above")
        states = {run.folder: status(run) for run in waiting}
        return {
            folder: str(state)
            for folder, state in states.items()
            if state.state not in ("done", "running")
        }

    def command(self, grid: Grid, runs: Sequence[ExperimentConfig]) -> list[str]:
        """Return the command of the multirun.

        Args:
            grid: of the runs.
            runs: those to start.
        """
        indices = [grid.runs.index(run) for run in runs]
        options = {
            "submitit_folder": str(grid.folder / "submitit" / "%j"),
            "cpus_per_task": self.cpus,
            "gpus_per_node": self.gpus,
            "mem_gb": self.memory_gb,
            **({} if self.cluster == "local" else {"array_parallelism": grid.jobs}),
            **({} if grid.max_hours is None else {"timeout_min": self._minutes(grid.max_hours)}),
            **self.options,
        }
        return [
            *(sys.executable, "-m", "ba_torchrl", "benchmark", "--multirun"),
            *(word for word in grid.words if not _OWN_OPTION.match(word)),
            f"only={','.join(map(str, indices))}",
            f"hydra/launcher=submitit_{self.cluster}",
            f"hydra.sweep.dir={grid.folder / 'submitit'}",
            "hydra.sweep.subdir=.",
            *(f"hydra.launcher.{name}={value}" for name, value in options.items()),
        ]

    @staticmethod
    def _minutes(hours: float) -> int:
        return round(60 * hours) + _MINUTES_TO_SAVE
