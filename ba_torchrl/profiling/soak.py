"""Soak test: thousands of steps of each task, in which faults, memory and clients are counted.

Each task has a process of its own, and its figures are written to a file when it is complete. The
same call continues with the tasks without a file.
"""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from tqdm import tqdm

from ba_torchrl.data.files import write_text

logger = logging.getLogger(__name__)

WORKER = (sys.executable, "-m", "ba_torchrl.profiling.soak_one")
MAX_GROWTH = 0.02
"""Limit of the growth of the resident memory after the warm-up, as a fraction."""
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
    def problems(self) -> list[str]:
        """The criteria that are not met."""
        problems = []
        if self.faults:
            problems.append(f"{self.faults} faults")
        if self.memory_growth > MAX_GROWTH:
            problems.append("memory grows")
        if self.clients_left:
            problems.append("clients left")
        return problems


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
            failures[job.task] = ", ".join(figures.problems)
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
        figures = SoakFigures.model_validate(json.loads(path.read_text()))
    except (ValueError, ValidationError, RecursionError) as error:
        logger.warning("%s is damaged and measured again: %s", path, error)
        return None
    return figures if figures.job == job else None
