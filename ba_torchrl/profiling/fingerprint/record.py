"""Run cases and return their records."""

from __future__ import annotations

import importlib.metadata
import logging
import multiprocessing
import os
import random
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from ba_torchrl.errors import ConfigError
from ba_torchrl.profiling.fingerprint.cases import Case
from ba_torchrl.profiling.fingerprint.environments import run_env, run_gym, run_state, run_vector
from ba_torchrl.profiling.fingerprint.training import run_training

WORDS = 12
"""Words of an error's message that are recorded."""

RUNNERS: dict[str, Callable[[Case, dict[str, Any], dict[str, Any]], None]] = {
    "env": run_env,
    "state": run_state,
    "vector": run_vector,
    "parallel": run_vector,
    "gym": run_gym,
    "training": run_training,
}


def run_case(case: Case) -> dict[str, Any]:
    """Run a case and return its record, also of a refused configuration or a failure."""
    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    torch.manual_seed(case.seed)
    np.random.seed(case.seed)  # noqa: NPY002 -- in case a library draws from it
    random.seed(case.seed)
    facts: dict[str, Any] = {}
    traces: dict[str, Any] = {}
    try:
        RUNNERS[case.kind](case, facts, traces)
    except ConfigError as error:
        facts["refused"] = _briefly(error)
    except Exception as error:
        facts["failed"] = f"{type(error).__name__}: {_briefly(error)}"
    return {"part": case.part, "task": case.task, "facts": facts, "traces": traces}


def run_all(wanted: list[Case], workers: int) -> dict[str, dict[str, Any]]:
    """Run cases in worker processes; return their records by name, in the order of the cases."""
    os.environ |= {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}  # for the processes
    context = multiprocessing.get_context("spawn")
    records = {}
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        futures = {pool.submit(run_case, case): case for case in wanted}
        interval_s = 0.1 if sys.stderr.isatty() else 10.0
        done = as_completed(futures)
        for future in tqdm(done, total=len(futures), unit="case", mininterval=interval_s):
            records[futures[future].name] = future.result()
    return {case.name: records[case.name] for case in wanted}


def versions() -> dict[str, str]:
    """Return the versions of the libraries that the numbers depend on."""
    packages = ("torch", "torchrl", "tensordict", "numpy", "pybullet", "numba", "scipy", "escnn")
    found = {}
    for package in packages:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "none"
    return found


def _briefly(error: Exception) -> str:
    return " ".join(str(error).split()[:WORDS])
