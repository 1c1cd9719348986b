"""The soak test of one task: reads a job as JSON from standard input, and prints its figures."""

from __future__ import annotations

import gc
import os
import sys
import time
from pathlib import Path

import torch

from ba_torchrl import make
from ba_torchrl.data.demos import expert_policy
from ba_torchrl.envs import keys
from ba_torchrl.plugins import load_plugins
from ba_torchrl.profiling.soak import SoakFigures, SoakJob
from ba_torchrl.record.logging import limit_library_logs
from ba_torchrl.sim.world import count_clients

SAMPLES = 100
"""Number of measurements of the memory."""


def soak(job: SoakJob) -> SoakFigures:
    """Play episodes of random and of the expert's actions in this process.

    Args:
        job: the task and the number of steps.
    """
    load_plugins(job.plugins)
    clients = count_clients()
    torch.manual_seed(job.seed)
    env = make(job.task, **{**job.env, "seed": job.seed, "expert": True})
    outcomes: list[bool] = []
    memory_mb: list[float] = []
    sample_every = max(job.steps // SAMPLES, 1)
    episodes = 0
    state = env.reset()
    start = time.perf_counter()
    for step in range(job.steps):
        is_experts = episodes % 2 == 1
        action = expert_policy(state)[keys.ACTION] if is_experts else env.action_spec.rand()
        following = env.step(state.set(keys.ACTION, action))[keys.NEXT]
        state = following.exclude(keys.REWARD)
        if following[keys.DONE]:
            if is_experts:
                outcomes.append(bool(following[keys.SUCCESS]))
            episodes += 1
            state = env.reset()
        if step % sample_every == 0:
            gc.collect()
            memory_mb.append(_resident_mb())
    seconds = time.perf_counter() - start
    env.close()
    quarter = len(memory_mb) // 4
    first, last = (
        sum(part) / quarter for part in (memory_mb[quarter : 2 * quarter], memory_mb[-quarter:])
    )
    return SoakFigures(
        job=job,
        episodes=episodes,
        expert_success=sum(outcomes) / len(outcomes) if outcomes else None,
        faults=env.faults,
        steps_per_s=job.steps / seconds,
        memory_mb=first,
        memory_growth=last / first - 1,
        clients_left=count_clients() - clients,
    )


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> None:
    """Run a job."""
    limit_library_logs()
    job = SoakJob.model_validate_json(sys.stdin.read())
    sys.stdout.write(soak(job).model_dump_json() + "\n")


if __name__ == "__main__":
    main()
