"""Report the results of runs: a folder with a page, curves, tables, values by seed and videos.

ba-torchrl report runs/
ba-torchrl report 'runs=[runs/close_loop_3d,runs/close_loop_4d]' folder=report axis=updates
ba-torchrl report runs/mine 'plugins=[my_tasks]'
"""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from ba_torchrl.cli import config_dir
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Folders, OutputFolder, PluginSettings, check_writable_folder
from ba_torchrl.commands import benchmark as benchmark_command
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.plugins import check_known
from ba_torchrl.record.report import write_report
from ba_torchrl.record.results import NON_LEARNING_FIELDS, RESULT_FILE, RunResult, differences
from ba_torchrl.record.summary import Axis, Run, load_runs, sections
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.grid.plan import expand, split

logger = logging.getLogger(__name__)

_NOT_OPENED = {"demonstrations_path": None, "demonstrations_mapping": None, "logger": "csv"}
"""Settings of a run that name files or packages of its machine, with values that name none."""


class Settings(PluginSettings):
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
    runs, unfinished = load_runs(settings.runs)
    if not runs:
        where = ", ".join(settings.runs)
        raise ConfigError(f"no finished run below {where}: a run leaves {RESULT_FILE} when it ends")
    found = sections(completed(runs), changes)
    check_writable_folder(folder)
    page = write_report(found, unfinished, folder, settings.axis)
    print((folder / "table.md").read_text(encoding="utf-8"))
    print(f"  page    {page}")
    print(f"  figures {folder / '*.pdf'}, the same as .svg")
    tables = "table.md, comparisons.csv; by seed seeds.csv, curves.csv"
    print(f"  tables  {folder / 'table.csv'}, {tables}")


def completed(runs: Iterable[Run]) -> list[Run]:
    """Return runs with the defaults of settings that are newer than they are.

    A run is returned as it is if this version does not know its settings, or if it names plugins
    that are not imported, which a warning says. The files that its settings name are not opened.
    """
    from ba_torchrl.training.checkpoint import parse_saved  # imports torch, which takes seconds

    found: list[Run] = []
    reasons: dict[str, ConfigError] = {}
    for run in runs:
        config, result = run.result.config, run.result
        try:
            check_known(config.get("plugins"), run.folder)
        except ConfigError as error:
            reasons.setdefault(str(config["plugins"]), error)
            found.append(run)
            continue
        with contextlib.suppress(ConfigError):
            known = parse_saved(config, run.folder, device="cpu", **_NOT_OPENED).resolved()
            known |= {name: config[name] for name in _NOT_OPENED if name in config}
            run = replace(run, result=result.model_copy(update={"config": known}))
        found.append(run)
    for reason in reasons.values():
        logger.warning("settings are as the run saved them: %s", reason)
    return found


def changes(run: RunResult) -> dict[str, tuple[Any, Any]]:
    """Return the settings in which a run differs from the package's benchmark of its name."""
    if run.benchmark not in [file.stem for file in (config_dir() / "benchmark").glob("*.yaml")]:
        return {}
    planned = _planned(run.benchmark).get((run.task, run.label))
    if planned is None:
        return {"tasks, algorithms and networks": (f"{run.task} with {run.label}", "those listed")}
    return differences(run.config, planned.resolved(), {*NON_LEARNING_FIELDS, "seed"})


@functools.cache
def _planned(benchmark: str) -> dict[tuple[str, str], ExperimentConfig]:
    """Return the runs of one of the package's benchmarks by task and label."""
    from ba_torchrl.training.presets import composed, preset

    with composed(config_dir(), "benchmark", [f"benchmark={benchmark}"]) as settings:
        own = {"name": benchmark, "seeds": [0]}
        values = OmegaConf.to_container(OmegaConf.merge(settings, own), resolve=True)
        grid, common = split(values, benchmark_command.Settings)
        return {(run.task, run.label): run for run in expand(grid, common, preset)}


COMMAND = Command(main, Settings, positional="runs")
