"""Run a benchmark: tasks x algorithms x networks x seeds. The same command continues a grid.

python recipes/benchmark.py benchmark=close_loop_4d seeds=4
python recipes/benchmark.py benchmark=close_loop_4d dry_run=true       # list the states of the runs
python recipes/benchmark.py tasks=[close_loop/block_picking] networks=[cnn] total_updates=600 \
    env.obs_size=64 network.width=0.5 folder=runs/small
python recipes/benchmark.py benchmark=close_loop_4d launcher=ray launcher.cpus=4
python recipes/benchmark.py benchmark=close_loop_4d launcher=submitit launcher.options.partition=gpu
"""

import signal
import sys
from collections import Counter
from pathlib import Path

import hydra
from omegaconf import DictConfig, OmegaConf
from pydantic import Field

from ba_torchrl.config import StrictModel, parse
from ba_torchrl.errors import ConfigError
from ba_torchrl.record.logging import limit_library_logs
from ba_torchrl.training import hydra_schema
from ba_torchrl.training.command_line import (
    check_writable_folder,
    plain_errors,
    register_schemas,
)
from ba_torchrl.training.config import choose
from ba_torchrl.training.grid.launchers.base import LAUNCHERS, Grid
from ba_torchrl.training.grid.plan import BenchmarkConfig, plan, status

register_schemas()


class Settings(StrictModel):
    """Settings of this command besides those of the grid and its runs."""

    dry_run: bool
    only: int | None = Field(ge=0)


@hydra.main(config_path="../configs", config_name="benchmark", version_base="1.3")
@plain_errors
def main(settings: DictConfig) -> None:
    """Run the unfinished runs of the grid, or list all of them."""
    limit_library_logs()
    values = OmegaConf.to_container(settings, resolve=True)
    own = parse(Settings, {name: values.pop(name) for name in Settings.model_fields}, "settings")
    dry_run, only = own.dry_run, own.only
    grid = {name: values.pop(name) for name in BenchmarkConfig.model_fields if name in values}
    config = parse(BenchmarkConfig, grid, "benchmark")
    if not dry_run:
        check_writable_folder(config.folder)
    runs = plan(config, values, hydra_schema.preset)
    if only is not None and only >= len(runs):
        raise ConfigError(f"only: must be a number from 0 to {len(runs) - 1}, got {only}")
    if dry_run:
        states = {run.run_dir: status(run) for run in runs}
        for run in runs:
            print(f"{run.task:36} {run.label:20} seed {run.seed:<3} {states[run.run_dir]}")
        counts = Counter(state.state for state in states.values())
        print(f"{len(runs)} runs: {', '.join(f'{n} {state}' for state, n in counts.items())}")
        return
    if only is not None:
        runs = [runs[only]]
    launcher = choose(LAUNCHERS, config.launcher, "launcher")
    launcher.check(runs)
    # the runs end with this process
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    command = [sys.executable, *sys.argv]
    failures = launcher.run_all(
        Grid(runs, Path(config.folder), config.jobs, config.max_hours, command)
    )
    states = {run.run_dir: status(run) for run in runs}
    done = sum(state.state == "done" for state in states.values())
    print(f"{done} of {len(runs)} runs done in {config.folder}")
    for folder, state in states.items():
        if state.state == "running":
            print(f"  running {folder}: {state.detail}")
    for folder, reason in failures.items():
        print(f"  failed  {folder}: {reason}")
    if only is not None:
        return  # one of several jobs, which all end; the failure is recorded
    if failures:
        sys.exit(1)
    print(f"  next    python recipes/report.py {config.folder}")


if __name__ == "__main__":
    main()
