"""Grids on a Ray cluster and on SLURM."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from ba_torchrl.core.config import parse
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.results import read_result
from ba_torchrl.training.grid.launchers import ray as ray_launcher
from ba_torchrl.training.grid.launchers.base import LAUNCHERS, Grid
from ba_torchrl.training.grid.plan import status
from ba_torchrl.training.interruption import Interruption, StopSignals
from ba_torchrl.training.resume import resumable_updates
from tests.training.grid.grids import COMMON, REACH, planned
from tests.training.ray_nodes import ray_nodes

ROOT = Path(__file__).parents[3]
WORDS = ["seeds=2", "launcher=submitit", "jobs=3"]


def launcher(name, **options):
    return parse(LAUNCHERS[name], options, name)


def grid_of(runs, folder, **changes):
    values = {"jobs": 1, "max_hours": None, "words": WORDS}
    return Grid(runs=runs, folder=Path(folder), **{**values, **changes})


@pytest.mark.parametrize("name", ["ray", "submitit"])
def test_without_the_package_one_line_says_how_to_install_it(name, tmp_path, monkeypatch):
    for module in ("ray_cluster", "grid.launchers.submitit"):
        monkeypatch.setattr(f"ba_torchrl.training.{module}.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=rf"pip install .*{name}") as raised:
        launcher(name).check(planned(tmp_path))
    assert "\n" not in str(raised.value)


def test_runs_on_a_cluster_start_no_workers_there(tmp_path, monkeypatch):
    monkeypatch.setattr("ba_torchrl.training.ray_cluster.find_spec", lambda name: True)
    runs = planned(tmp_path, common={"collector": {"name": "ray"}})
    with pytest.raises(ConfigError, match="wait for their own workers"):
        launcher("ray").check(runs)


def test_a_task_stops_at_its_time_limit_with_its_state_saved(tmp_path, monkeypatch):
    (run,) = planned(tmp_path, seeds=1)

    def run_until_stopped(values):
        with StopSignals() as signals:
            try:
                while True:
                    time.sleep(0.01)
                    signals.check()
            except Interruption:
                raise signals.stopped(True, run.folder) from None

    monkeypatch.setattr(ray_launcher, "run_experiment", run_until_stopped)
    with pytest.raises(TimeoutError, match=r"max_hours.*SIGTERM, state saved"):
        ray_launcher._run_in_task(run.model_dump_json(), max_hours=1e-4)
    assert (run.folder / "run.log").exists()


def test_submitit_repeats_the_command_as_a_multirun_of_the_unfinished_runs(tmp_path):
    runs = planned(tmp_path, seeds=3)
    options = {"partition": "gpu"}
    found = launcher("submitit", gpus=1, options=options).command(
        grid_of(runs, "runs/g", jobs=3, max_hours=2.0), runs[1:]
    )
    start = [sys.executable, "-m", "ba_torchrl", "benchmark", "--multirun"]
    assert found[:7] == [*start, "seeds=2", "jobs=3"]
    assert found[7:] == [
        "only=1,2",
        "hydra/launcher=submitit_slurm",
        "hydra.sweep.dir=runs/g/submitit",
        "hydra.sweep.subdir=.",
        "hydra.launcher.submitit_folder=runs/g/submitit/%j",
        "hydra.launcher.cpus_per_task=2",
        "hydra.launcher.gpus_per_node=1",
        "hydra.launcher.mem_gb=16",
        "hydra.launcher.array_parallelism=3",
        "hydra.launcher.timeout_min=125",
        "hydra.launcher.partition=gpu",
    ]


def overrides(folder):
    """The command line of the grid of `grids.planned`."""
    env, rest = COMMON["env"], {k: v for k, v in COMMON.items() if not isinstance(v, dict)}
    return [
        f"tasks=[{REACH}]",
        "algorithms=[sac]",
        "networks=[cnn]",
        "network.width=0.25",
        "algorithm.batch_size=8",
        f"folder={folder}",
        *(f"env.{name}={value}" for name, value in env.items()),
        *(f"{name}={value}" for name, value in rest.items()),
    ]


def benchmark(*arguments, **variables):
    return subprocess.run(
        [sys.executable, "recipes/benchmark.py", *arguments],
        cwd=ROOT,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=280,
    )


@pytest.mark.slow
def test_submitit_runs_a_grid(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    options = ("launcher=submitit", "launcher.cluster=local", "launcher.memory_gb=2")
    done = benchmark(*overrides(tmp_path / "grid"), "seeds=2", *options)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "2 of 2 runs done" in done.stdout
    assert len(list((tmp_path / "grid").rglob("result.json"))) == 2


@pytest.mark.slow
def test_submitit_submits_a_job_array_to_slurm(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    script = tmp_path / "submitted.sh"
    for name, text in {
        "sbatch": f'cp "$1" {script}\necho "Submitted batch job 77"',
        "srun": "exit 0",
        "sacct": "exit 1",
    }.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    command = [sys.executable, "recipes/benchmark.py", *overrides(tmp_path / "grid"), "seeds=3"]
    process = subprocess.Popen(
        [*command, "launcher=submitit", "launcher.options.partition=gpu", "jobs=2", "max_hours=1"],
        cwd=ROOT,
        env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"},
        start_new_session=True,
    )
    try:
        for _ in range(1200):
            if script.exists():
                break
            time.sleep(0.1)
    finally:
        os.killpg(process.pid, 9)
        process.wait()
    lines = script.read_text()
    for option in ("--array=0-2%2", "--partition=gpu", "--time=65", "--cpus-per-task=2"):
        assert f"#SBATCH {option}" in lines


@pytest.mark.slow
def test_ray_repeats_the_run_of_a_failed_node_from_its_last_state(tmp_path):
    runs = planned(tmp_path, seeds=4, common={"total_updates": 120, "eval_every": 10})
    with ray_nodes(3) as (cluster, nodes, _):
        removed = []

        def fail():
            deadline = time.monotonic() + 240
            while time.monotonic() < deadline:
                if any((resumable_updates(run.folder) or 0) >= 10 for run in runs):
                    removed.append(nodes[0])
                    cluster.remove_node(nodes[0], allow_graceful=False)
                    return
                time.sleep(0.1)

        thread = threading.Thread(target=fail)
        thread.start()
        failures = launcher("ray").run_all(grid_of(runs, tmp_path / "grid"))
        thread.join()
    assert failures == {}
    assert len(removed) == 1
    assert {status(run).state for run in runs} == {"done"}
    results = [read_result(run.folder) for run in runs]
    assert [len(result.curve) for result in results] == [13] * 4
    resumed = [result.resumed_at for result in results if result.resumed_at]
    assert len(resumed) == 1


@pytest.mark.slow
def test_ray_records_the_failure_of_a_run(tmp_path):
    good, bad = planned(tmp_path, seeds=2)
    bad = bad.model_copy(update={"demonstrations_path": str(tmp_path / "missing")})
    with ray_nodes(1):
        failures = launcher("ray").run_all(grid_of([good, bad], tmp_path / "grid"))
    assert list(failures) == [bad.folder]
    assert "missing" in failures[bad.folder]
    assert status(good).state == "done"
    assert "missing" in status(planned(tmp_path, seeds=2)[1]).detail
