"""Soak test: thousands of steps of every task; a table of faults, memory and clients left open.

python recipes/soak.py                                        # the same command continues it
python recipes/soak.py steps=100 long_steps=500 folder=/tmp/soak
python recipes/soak.py 'tasks=[open_loop/bin_packing]' steps=5000

Each task has a process of its own, and its figures are written to a file when it is complete. The
same call continues with the tasks without a file.
"""

from __future__ import annotations

import gc
import logging
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from tqdm import tqdm

from ba_torchrl import list_tasks, make
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import EnvSettings, OutputFolder, TaskId, Tasks, check_writable_file
from ba_torchrl.core import keys
from ba_torchrl.core.files import read_json, write_text
from ba_torchrl.core.plugins import load_plugins
from ba_torchrl.envs.policies import expert_policy
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.record.logging import limit_library_logs
from ba_torchrl.sim.world import count_clients

logger = logging.getLogger(__name__)

JOB_FLAG = "--job"
WORKER = (sys.executable, __file__, JOB_FLAG)
MAX_GROWTH = 0.02
"""Limit of the growth of the resident memory after the warm-up, as a fraction."""
SAMPLES = 100
"""Number of measurements of the memory."""
LOG_LINES = 5
TABLE_FILE = "soak.md"


class SoakJob(BaseModel):
    """What one process does.

    Args:
        task: id of the task.
        steps: number of steps; episodes of random and of the expert's actions alternate.
        seed: of the episodes and of the random actions.
        env: fields of `EnvConfig`.
        plugins: modules that register the task.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    task: str
    steps: int = Field(ge=10)
    seed: int = Field(default=0, ge=0)
    env: dict[str, Any] = {}
    plugins: tuple[str, ...] = ()


class SoakFigures(BaseModel):
    """What one process measured."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    job: SoakJob
    episodes: int
    expert_success: float | None
    """Fraction of the expert's complete episodes that reached the goal; None without any."""
    faults: int
    steps_per_s: float
    memory_mb: float
    """Resident memory after the warm-up, the first quarter of the steps."""
    memory_growth: float
    """Growth of the resident memory from there to the last quarter, as a fraction."""
    clients_left: int
    """Open connections to PyBullet after the environment is closed."""

    @property
    def problems(self) -> str:
        """The criteria that are not met."""
        criteria = {
            f"{self.faults} faults": self.faults,
            "memory grows": self.memory_growth > MAX_GROWTH,
            "clients left": self.clients_left,
        }
        return ", ".join(problem for problem, applies in criteria.items() if applies)


class Settings(EnvSettings):
    """Settings of this command."""

    set_by_command: ClassVar[dict[str, str]] = {
        "seed": "set seed",
        "expert": "set steps: every other episode is the expert's",
    }
    tasks: Tasks = None
    """Ids of tasks; null for all."""
    steps: int = Field(default=1000, ge=10)
    """Steps of a task."""
    long_tasks: list[TaskId] = Field(
        [
            "close_loop/block_picking",
            "close_loop/object_grasping",
            "open_loop/house_building_4",
            "open_loop/bin_packing",
        ]
    )
    """A task of each kind, with more steps."""
    long_steps: int = Field(default=20_000, ge=10)
    """Steps of these."""
    folder: OutputFolder = "soak"
    """One file of figures per task, and the table."""


def main(settings: Settings) -> None:
    """Run the tasks without figures, and print the table."""
    tasks = settings.tasks or list_tasks()
    for task in tasks:
        resolve_env(task, settings.env)  # raises with the known names
    folder = Path(settings.folder)
    check_writable_file(folder / TABLE_FILE)
    jobs = [
        SoakJob(
            task=task,
            steps=settings.long_steps if task in settings.long_tasks else settings.steps,
            seed=settings.seed,
            env=settings.env,
            plugins=settings.plugins,
        )
        for task in tasks
    ]
    failures = run_soak(jobs, folder)
    table = folder / TABLE_FILE
    if table.exists():
        print(f"\n{table.read_text()}")
    for task, failure in failures.items():
        print(f"{task}: {failure}")
    if failures:
        sys.exit(1)


def run_soak(
    jobs: Sequence[SoakJob],
    folder: Path,
    *,
    progress: bool = True,
    worker: Sequence[str] = WORKER,
) -> dict[str, str]:
    """Run the jobs without figures, and write a table of all figures to `TABLE_FILE`.

    Args:
        jobs: one per task.
        folder: of the files with figures.
        progress: show a progress bar over the jobs.
        worker: command that reads a job as JSON from its standard input and prints its figures.

    Returns:
        By task, the end of the output of a process that failed, or the criteria that are not met.
    """
    folder.mkdir(parents=True, exist_ok=True)
    failures: dict[str, str] = {}
    done: dict[str, SoakFigures] = {}
    for job in tqdm(jobs, unit="task", disable=not progress):
        path = folder / f"{job.task.replace('/', '-')}.json"
        figures = _read(path, job)
        if figures is None:
            process = subprocess.run(
                worker, input=job.model_dump_json(), capture_output=True, text=True, check=False
            )
            if process.returncode:
                last = process.stderr.strip().splitlines()[-LOG_LINES:]
                failures[job.task] = "\n".join([f"exit code {process.returncode}", *last])
                continue
            figures = SoakFigures.model_validate_json(process.stdout.splitlines()[-1])
            write_text(path, figures.model_dump_json(indent=2))
        done[job.task] = figures
        write_text(folder / TABLE_FILE, as_table(done.values()))
        if figures.problems:
            failures[job.task] = figures.problems
    return failures


def as_table(figures: Iterable[SoakFigures]) -> str:
    """Return a table in Markdown, one row per task."""
    lines = [
        "| task | steps | episodes | expert's success | faults | steps/s | memory, MB | growth "
        "| clients left |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in figures:
        success = "-" if row.expert_success is None else f"{row.expert_success:.2f}"
        lines.append(
            f"| `{row.job.task}` | {row.job.steps} | {row.episodes} | {success} | {row.faults} "
            f"| {row.steps_per_s:.0f} | {row.memory_mb:.0f} | {row.memory_growth:+.1%} "
            f"| {row.clients_left} |"
        )
    return "\n".join(lines) + "\n"


def _read(path: Path, job: SoakJob) -> SoakFigures | None:
    """Return the figures of a job; None if there are none, or those of another job."""
    if not path.exists():
        return None
    try:
        figures = SoakFigures.model_validate(read_json(path))
    except (ValueError, ValidationError, RecursionError) as error:
        logger.warning("%s is damaged and measured again: %s", path, error)
        return None
    return figures if figures.job == job else None


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
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            memory_mb.append(pages * os.sysconf("SC_PAGE_SIZE") / 1e6)
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


COMMAND = Command(main, Settings, positional="tasks")


def run_job() -> None:
    """Read a job as JSON from standard input, and print its figures."""
    limit_library_logs()
    job = SoakJob.model_validate_json(sys.stdin.read())
    print(soak(job).model_dump_json())


if __name__ == "__main__":
    if sys.argv[1:] == [JOB_FLAG]:
        run_job()
    else:
        COMMAND.run()
