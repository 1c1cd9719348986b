"""Grids on a Ray cluster."""

import io
import multiprocessing
import threading
import time
import weakref
from pathlib import Path

import pytest
from tqdm import tqdm
from tqdm.std import TqdmDefaultWriteLock

from ba_torchrl.core.config import parse
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.results import read_result
from ba_torchrl.training.checkpoint import resumable_updates
from ba_torchrl.training.grid.launchers import ray as ray_launcher
from ba_torchrl.training.grid.launchers.base import LAUNCHERS, Grid
from ba_torchrl.training.grid.plan import status
from ba_torchrl.training.interruption import Interruption, StopSignals
from tests.training.grid.grids import planned
from tests.training.ray_nodes import ray_nodes


def launcher(name, **options):
    return parse(LAUNCHERS[name], options, name)


def grid_of(runs, folder):
    return Grid(runs=runs, folder=Path(folder), jobs=1, max_hours=None)


def test_without_the_package_one_line_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setattr("ba_torchrl.training.ray_cluster.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install .*ray") as raised:
        launcher("ray").check(planned(tmp_path))
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
        ray_launcher._run_in_task(run.folder, b"", max_hours=1e-4)
    assert (run.folder / "run.log").exists()


def test_a_task_leaves_no_semaphore_whose_tracker_ray_ends(tmp_path, monkeypatch):
    (run,) = planned(tmp_path, seeds=1)
    left = []

    class Cycle:
        def __init__(self):
            self.itself, self.semaphore = self, multiprocessing.get_context("spawn").Lock()

    def experiment(_):
        tqdm(total=1, disable=False, file=io.StringIO()).close()
        left.append(weakref.ref(Cycle().semaphore))

    for owner, name in ((tqdm, "_lock"), (TqdmDefaultWriteLock, "mp_lock")):
        monkeypatch.delattr(owner, name, raising=False)
    monkeypatch.setattr(ray_launcher, "run_experiment", experiment)
    ray_launcher._run_in_task(run.folder, b"", max_hours=None)
    assert left[0]() is None
    assert not hasattr(TqdmDefaultWriteLock, "mp_lock")


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
