"""Run a benchmark: tasks x algorithms x networks x seeds. The same command continues a grid.

ba-torchrl benchmark benchmark=close_loop_4d seeds=4
ba-torchrl benchmark benchmark=close_loop_4d dry_run=true       # list the states of the runs
ba-torchrl benchmark 'tasks=[close_loop/block_picking]' 'networks=[cnn]' total_updates=600 \
    env.obs_size=64 network.width=0.5 folder=runs/small
ba-torchrl benchmark benchmark=close_loop_4d launcher=ray launcher.cpus=4
ba-torchrl benchmark benchmark=close_loop_4d only=$SLURM_ARRAY_TASK_ID
"""

from __future__ import annotations

import math
import shlex
import signal
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from pydantic import Field

from ba_torchrl.cli.command import Arguments, Command
from ba_torchrl.cli.types import TaskId, check_writable_folder
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.training import presets
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.grid.plan import BenchmarkConfig, Status, plan, split, status


class Settings(BenchmarkConfig):
    """The grid, and what to do with it."""

    tasks: list[TaskId] = Field(min_length=1)
    """Ids of tasks."""
    dry_run: bool = False
    """List the runs and their states."""
    only: int | None = Field(default=None, ge=0)
    """Number of the only run to start, from 0 on, in the order of ``dry_run``."""


class PlannedRuns(NamedTuple):
    """A grid and its runs."""

    settings: Settings
    runs: list[ExperimentConfig]


def parse(values: dict[str, Any], _: Arguments) -> PlannedRuns:
    """Return the grid with its runs, all of them checked."""
    settings, common = split(values, Settings)
    if not settings.dry_run:
        check_writable_folder(settings.folder)
    runs = plan(settings, common, presets.preset)
    if settings.only is not None and settings.only >= len(runs):
        raise ConfigError(f"only: must be a number from 0 to {len(runs) - 1}, got {settings.only}")
    return PlannedRuns(settings, runs)


def main(planned: PlannedRuns) -> None:
    """Run the unfinished runs of the grid, or list all of them."""
    from ba_torchrl.training.grid.launchers.base import Grid

    config, runs, only = planned.settings, planned.runs, planned.settings.only
    if only is not None and not config.dry_run:
        runs = [runs[only]]
    states = [(run, status(run)) for run in runs]
    if config.dry_run:
        for run, state in states:
            print(f"{run.task:36} {run.label:20} seed {run.seed:<3} {state}")
        counts = Counter(state.state for _, state in states)
        print(f"{len(runs)} runs: {', '.join(f'{n} {state}' for state, n in counts.items())}")
    launcher = config.launcher
    print_estimate(states, config.jobs if launcher.uses_jobs else 1)
    if config.dry_run:
        return
    launcher.check(runs)
    # the runs end with this process
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    grid = Grid(runs, Path(config.folder), config.jobs, config.max_hours)
    try:
        failures = launcher.run_all(grid)
    except (KeyboardInterrupt, SystemExit):
        sys.stderr.write("the same command continues the grid\n")
        raise
    finally:
        signal.signal(signal.SIGTERM, before)
    states = [(run, status(run)) for run in runs]
    done = sum(state.state == "done" for _, state in states)
    print(f"{done} of {len(runs)} runs done in {config.folder}")
    for run, state in states:
        if state.state == "running":
            print(f"  running {run.run_dir}: {state.detail}")
    for folder, reason in failures.items():
        print(f"  failed  {folder}: {reason}")
    if failures:
        sys.exit(1)
    if only is None:
        print(f"  next    {shlex.join(['ba-torchrl', 'report', config.folder])}")


def print_estimate(states: Sequence[tuple[ExperimentConfig, Status]], at_once: int) -> None:
    """Print how long the runs take that are not done, if some of the same task and method are."""
    seconds = defaultdict(list)
    for run, state in states:
        seconds[run.task, run.label] += [] if state.seconds is None else [state.seconds]
    left = [seconds[run.task, run.label] for run, state in states if state.state != "done"]
    known = [fmean(each) for each in left if each]
    if known:
        at_once = min(at_once, len(known))
        hours, minutes = divmod(math.ceil(sum(known) / at_once / 60), 60)
        duration = f"{hours} h {minutes} min" if hours else f"{minutes} min"
        runs = f"{len(known)} of {len(left)}"
        print(f"about {duration} for {runs} runs, {at_once} at a time, as finished ones took")


COMMAND = Command(main, Settings, config="benchmark", further=ExperimentConfig, parse=parse)
