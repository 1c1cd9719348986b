"""The launcher on a Ray cluster: each run is a Ray task, which Ray repeats if its machine fails."""

from __future__ import annotations

import gc
import logging
import os
import pickle
import signal
import threading
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ba_torchrl.record.results import FAILURE_FILE
from ba_torchrl.training.grid.jobs import LOG_FILE, SAVE_S, record_failure, unfinished
from ba_torchrl.training.grid.launchers.base import Grid
from ba_torchrl.training.grid.launchers.ray_config import RayLauncherConfig
from ba_torchrl.training.grid.run_one import run_experiment
from ba_torchrl.training.interruption import RunStopped
from ba_torchrl.training.ray_cluster import check_resources, connected_ray, ray_module

_FOREVER_S = 1e6


def run_all(config: RayLauncherConfig, grid: Grid) -> dict[Path, str]:
    """Run the unfinished runs; see `LauncherConfig.run_all`."""
    waiting, failures = unfinished(grid.runs)
    ray = connected_ray(config.address)
    check_resources("launcher", config.cpus, config.gpus)
    task = ray.remote(
        num_cpus=config.cpus,
        num_gpus=config.gpus,
        max_retries=config.max_retries,
        max_calls=1,  # a process of its own for each run
    )(_run_in_task)
    pending = {}
    for run in waiting:
        (run.folder / FAILURE_FILE).unlink(missing_ok=True)
        where = {"run_dir": str(run.folder.resolve())}
        pickled = pickle.dumps(run.model_copy(update=where))
        pending[task.remote(run.folder.resolve(), pickled, grid.max_hours)] = run
    bar = tqdm(total=len(grid.runs), initial=len(grid.runs) - len(waiting), unit="run")
    try:
        while pending:
            for reference in ray.wait(list(pending))[0]:
                reason = _reason(reference)
                run = pending.pop(reference)
                if reason is not None:
                    failures[run.folder] = reason
                    record_failure(run, reason)
                    tqdm.write(f"failed: {run.folder}: {reason}")
                bar.update()
    finally:
        for reference in pending:  # they save their states
            ray.cancel(reference)
        if pending:
            ray.wait(list(pending), num_returns=len(pending), timeout=SAVE_S)
        bar.close()
    return failures


def _reason(reference: Any) -> str | None:
    """Return why a task that has ended failed; None if it did not."""
    exceptions = ray_module().exceptions
    try:
        ray_module().get(reference)
    except exceptions.RayTaskError as error:
        return f"{type(error.cause).__name__}: {error.cause}".splitlines()[0]
    except exceptions.RayError as error:
        return f"{type(error).__name__}: {str(error).splitlines()[0]}"
    return None


def _run_in_task(folder: Path, pickled: bytes, max_hours: float | None) -> None:
    """Run an experiment in this process, with the log file of its folder.

    Ray ends the child processes of this one before the exit of Python, among them the tracker of
    semaphores. Those that exist until then would be reported as lost, so none does.
    """
    tqdm.set_lock(threading.RLock())  # in place of a semaphore
    folder.mkdir(parents=True, exist_ok=True)
    handler = logging.FileHandler(folder / LOG_FILE)
    logging.getLogger().addHandler(handler)
    seconds = _FOREVER_S if max_hours is None else 3600 * max_hours
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGTERM))
    timer.daemon = True
    timer.start()
    try:
        run_experiment(pickled)
    except RunStopped as stopped:  # a task that raises SystemExit is repeated
        raise TimeoutError(f"took longer than max_hours, or was cancelled: {stopped}") from None
    except Exception:
        logging.getLogger(__name__).exception("the run failed")
        raise
    finally:
        timer.cancel()
        logging.getLogger().removeHandler(handler)
        gc.collect()
