"""Frames per second of collection with a random policy, in this process and in workers."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from functools import partial
from typing import Any

from torchrl.collectors import Collector

from ba_torchrl.envs.factory import make_env
from ba_torchrl.envs.vector.make import make_vector_env
from ba_torchrl.profiling.simulation import SEED, SimulationUnit
from ba_torchrl.profiling.table import Bench, Row, measurement

TASKS = ("close_loop/block_picking", "open_loop/block_stacking")
NUM_ENVS = (1, 2, 5)
STEPS = 20
"""Steps of each environment in a batch."""
UNIT_STEPS = 100
"""Units of work that are timed together, since one is much shorter than a batch."""
VECTORS: dict[str, dict[str, Any]] = {
    "one process": {"parallel": False},
    "workers, shared memory": {"parallel": True, "use_buffers": True},
    "workers, pipes": {"parallel": True, "use_buffers": False},
}
"""Options of `make_vector_env` by name."""


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
    plural = "environment" if num_envs == 1 else "environments"
    return [
        Row(
            f"{task}, collection, {num_envs} {plural}, {name}",
            "frames/s",
            [frames / value for value in times[name]],
            unit_s=unit_s,
            notes=f"batches of {frames} frames",
        )
        for name in VECTORS
    ]


def _repeat(unit: SimulationUnit) -> None:
    for _ in range(UNIT_STEPS):
        unit()


@contextlib.contextmanager
def _batches(task: str, num_envs: int, options: dict[str, Any]) -> Iterator[Iterator[Any]]:
    """Context in which a collector yields batches of a vector of environments."""
    env = make_vector_env(partial(make_env, task), num_envs, seed=SEED, **options)
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
