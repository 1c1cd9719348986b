"""Frames per second of collection: with a random policy in this process and in workers, and with a
run's policy by each collector."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Iterator
from functools import partial
from importlib.util import find_spec
from typing import Any

from torchrl.collectors import Collector

from ba_torchrl.core.config import WorkerOptions
from ba_torchrl.envs.factory import make
from ba_torchrl.envs.vector.make import make_vector
from ba_torchrl.training.collection import start_collection
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.learner import build_learner
from profiling.simulation import SEED, SimulationUnit
from profiling.table import Bench, Row, measurement

TASKS = ("close_loop/block_picking", "open_loop/block_stacking")
NUM_ENVS = (1, 2, 5)
STEPS = 20
"""Steps of each environment in a batch."""
ENVS_PER_WORKER = 2
ROUND_S = 2.0
"""Least duration of a round of a run's collection."""
WARM_UP_BATCHES = 10
RAY_CPUS = 0.5
"""Cores that Ray reserves for a worker, so that three fit two cores."""
UNIT_STEPS = 100
"""Units of work that are timed together, since one is much shorter than a batch."""
VECTORS: dict[str, dict[str, Any]] = {
    "one process": {"workers": WorkerOptions(parallel=False)},
    "workers, shared memory": {},
}
"""Options of `make_vector` by name."""


@measurement("throughput/collection", over=lambda: itertools.product(TASKS, NUM_ENVS))
def collection(bench: Bench, task: str, num_envs: int) -> list[Row]:
    """Frames per second of TorchRL's collector, which steps all environments together.

    The vectors are alternately measured; idle workers wait. Episodes that end are reset.
    """
    with contextlib.ExitStack() as stack:
        batches = {
            name: stack.enter_context(_batches(task, num_envs, options))
            for name, options in VECTORS.items()
        }
        unit = SimulationUnit()
        stack.callback(unit.world.close)
        calls = {name: partial(next, steps) for name, steps in batches.items()}
        times = bench.time_against({"units": partial(_repeat, unit)}, calls)
    unit_s = [value / UNIT_STEPS for value in times["units"]]
    frames = STEPS * num_envs
    return [
        Row(
            f"{task}, collection, {_number(num_envs, 'environment')}, {name}",
            "frames/s",
            [frames / value for value in times[name]],
            unit_s=unit_s,
            notes=f"batches of {frames} frames",
        )
        for name in VECTORS
    ]


def _collectors() -> list[tuple[str, int]]:
    """Return the collectors of runs with numbers of workers; Ray's only if it is installed."""
    several = [(name, n) for name in ("multi_sync", "multi_async") for n in (1, 2)]
    ray = [("ray", n) for n in (1, 2, 3)] if find_spec("ray") else []
    return [("single", 1), *several, *ray]


@measurement("throughput/collectors", over=_collectors)
def run_collection(bench: Bench, name: str, workers: int) -> list[Row]:
    """Frames per second of a run's collection by a CNN policy of 64 px, without updates.

    Ray's workers are on this machine.
    """
    collector: dict[str, Any] = {"name": name}
    if name != "single":
        collector |= {"workers": workers, "steps_per_batch": STEPS}
    if name == "ray":
        collector["cpus"] = RAY_CPUS
    config = ExperimentConfig.parse(
        {
            "task": TASKS[0],
            "env": {"obs_size": 64},
            "algorithm": {"name": "sac"},
            "network": {"name": "cnn"},
            "num_envs": ENVS_PER_WORKER * workers,
            "parallel": False,
            "collector": collector,
            "seed": SEED,
        }
    )
    with contextlib.ExitStack() as stack:
        unit = SimulationUnit()
        stack.callback(unit.world.close)
        batches = start_collection(config, build_learner(config), SEED, None)
        stack.callback(batches.close)
        frames, seconds, units = [], [], []
        for _ in range(WARM_UP_BATCHES):
            next(batches)
        for _ in bench.rounds():
            start, collected = time.perf_counter(), 0
            while time.perf_counter() - start < ROUND_S:
                collected += len(next(batches))
            seconds.append(time.perf_counter() - start)
            frames.append(collected)
            start = time.perf_counter()
            _repeat(unit)
            units.append((time.perf_counter() - start) / UNIT_STEPS)
    return [
        Row(
            f"{TASKS[0]}, collector={name}, {_number(workers, 'worker')}",
            "frames/s",
            [count / duration for count, duration in zip(frames, seconds, strict=True)],
            unit_s=units,
            notes=f"{ENVS_PER_WORKER} environments per worker",
        )
    ]


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _repeat(unit: SimulationUnit) -> None:
    for _ in range(UNIT_STEPS):
        unit()


@contextlib.contextmanager
def _batches(task: str, num_envs: int, options: dict[str, Any]) -> Iterator[Iterator[Any]]:
    """Context in which a collector yields batches of a vector of environments."""
    env = make_vector(partial(make, task), num_envs, seed=SEED, **options)
    collector = Collector(
        env,
        None,  # random actions
        frames_per_batch=STEPS * num_envs,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    try:
        yield iter(collector)
    finally:
        collector.shutdown()
