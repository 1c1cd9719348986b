"""Report the results of runs: a folder with a page, curves, tables, values by seed and videos.

ba-torchrl report runs/
ba-torchrl report 'runs=[runs/close_loop_3d,runs/close_loop_4d]' folder=report axis=updates
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from hydra import compose
from omegaconf import OmegaConf

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Folders, OutputFolder, check_writable_folder
from ba_torchrl.commands import benchmark as benchmark_command
from ba_torchrl.core.config import StrictModel
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.report import write_report
from ba_torchrl.record.results import NON_LEARNING_FIELDS, RunResult, differences
from ba_torchrl.record.summary import Axis, load_sections
from ba_torchrl.training import hydra_schema
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.grid.plan import expand, split


class Settings(StrictModel):
    """Settings of this command."""

    runs: Folders = "runs"
    """A folder or a list of folders; the report holds all finished runs below them."""
    folder: OutputFolder | None = None
    """Of the report; null for "report" in the first of the other folders."""
    axis: Axis = "env_steps"
    """Of the curves: steps of all environments, with those of demonstrations apart, or updates."""


def main(settings: Settings) -> None:
    """Write the report and print its tables."""
    folder = Path(settings.folder or Path(settings.runs[0]) / "report")
    runs = load_sections(settings.runs, changes, completed)
    check_writable_folder(folder)
    page = write_report(*runs, folder, settings.axis)
    print((folder / "table.md").read_text(encoding="utf-8"))
    print(f"  page    {page}")
    tables = "table.md, table.tex, comparisons.csv; by seed seeds.csv, curves.csv"
    print(f"  tables  {folder / 'table.csv'}, {tables}")


def changes(run: RunResult) -> dict[str, tuple[Any, Any]]:
    """Return the settings in which a run differs from the package's benchmark of its name."""
    if run.benchmark not in hydra_schema.preset_names("benchmark"):
        return {}
    planned = _planned(run.benchmark).get((run.task, run.label))
    if planned is None:
        return {"tasks, algorithms and networks": (f"{run.task} with {run.label}", "those listed")}
    found, ignored = completed(run).config, {*NON_LEARNING_FIELDS, "seed"}
    return differences(found, planned.resolved(), ignored)


def completed(run: RunResult) -> RunResult:
    """Return the result with the defaults of settings that are newer than the run.

    That of a run whose settings this version does not know is returned as it is.
    """
    try:
        config = ExperimentConfig.parse({**run.config, "device": "cpu"}).resolved()
    except ConfigError:
        return run
    return run.model_copy(update={"config": config})


@functools.cache
def _planned(benchmark: str) -> dict[tuple[str, str], ExperimentConfig]:
    """Return the runs of one of the package's benchmarks by task and label."""
    hydra_schema.register()
    overrides = [f"benchmark={benchmark}", f"name={benchmark}", "seeds=[0]"]
    values = OmegaConf.to_container(compose("benchmark", overrides), resolve=True)
    grid, common = split(values, benchmark_command.Settings)
    return {(run.task, run.label): run for run in expand(grid, common, hydra_schema.preset)}


COMMAND = Command(main, Settings, positional="runs")
