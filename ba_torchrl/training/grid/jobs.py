"""Jobs: the runs of a benchmark, each in a separate process (POSIX systems only).

Finished runs are skipped and interrupted ones resumed: the same command continues a grid. The
failure of a run is recorded and does not stop the others.
"""

from __future__ import annotations

import json
import math
import os
import pickle
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from ba_torchrl.core.errors import OtherRunError
from ba_torchrl.core.files import write_text
from ba_torchrl.record.logging import FILE_INTERVAL_S, last_step
from ba_torchrl.record.results import FAILURE_FILE, now
from ba_torchrl.training.checkpoint import run_holder
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.grid.plan import status

LOG_FILE = "run.log"
LOG_LINES = 20
"""Last lines of a failed run's output that are recorded."""
POLL_S = 0.2
REFRESH_S = 1.0
"""Time between two readings of the runs' updates, for the progress bar on a terminal."""
SAVE_S = 60.0
"""Time for a run to save its state before it is killed."""
WORKER = (sys.executable, "-m", "ba_torchrl.training.grid.run_one")


def run_all(
    runs: Sequence[ExperimentConfig],
    *,
    jobs: int = 1,
    max_hours: float | None = None,
    progress: bool = True,
    worker: Sequence[str] = WORKER,
) -> dict[Path, str]:
    """Run the unfinished runs of a grid.

    Args:
        runs: the runs, from `plan`.
        jobs: number of runs at the same time.
        max_hours: time limit of each run.
        progress: show a progress bar over the runs.
        worker: command of a process such as `run_one`.

    Returns:
        By run folder, the reason of its failure, also of a run whose files cannot be read. Runs
        that another process runs are left to it.

    Raises:
        OtherRunError: a folder holds a run with other settings, in which case nothing was started.
    """
    to_start, failures = unfinished(runs)
    waiting = deque(to_start)
    running: list[_Job] = []
    bar = tqdm(
        total=len(runs),
        initial=len(runs) - len(waiting),
        bar_format="{n_fmt}/{total_fmt} runs [{elapsed}<{remaining}{postfix}]",
        disable=not progress,
    )
    refresh_s = REFRESH_S if sys.stderr.isatty() else FILE_INTERVAL_S
    shown_at = -math.inf
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                run = waiting.popleft()
                holder = run_holder(run.folder)
                if holder is None:
                    running.append(_Job(run, worker, max_hours))
                else:
                    _report_skipped(run, holder)
                    bar.update()
            if time.monotonic() - shown_at > refresh_s:
                bar.set_postfix_str("; ".join(job.progress() for job in running))
                shown_at = time.monotonic()
            time.sleep(POLL_S)
            for job in [job for job in running if job.has_ended()]:
                running.remove(job)
                reason = job.close()
                if reason is not None:
                    failures[job.run.folder] = reason
                    tqdm.write(f"failed: {job}: {reason}; see {job.run.folder / LOG_FILE}")
                bar.update()
    finally:
        if running:
            tqdm.write("stopping: the present runs save their states")
        for job in running:
            job.terminate()
        while [job for job in running if not job.has_ended()]:
            time.sleep(POLL_S)
        bar.close()
    return failures


def unfinished(
    runs: Sequence[ExperimentConfig],
) -> tuple[list[ExperimentConfig], dict[Path, str]]:
    """Return the runs to start, which are not finished and which no other process runs; and, by
    folder, why a run is left out whose files cannot be read. `OtherRunError` if a folder holds a
    run with other settings."""
    states = [(run, status(run)) for run in runs]
    unreadable = {run.folder: found.detail for run, found in states if found.state == "unreadable"}
    for run, found in states:
        if found.state == "other":
            raise OtherRunError(found.detail)
        if found.state == "running":
            _report_skipped(run, found.detail)
    for reason in unreadable.values():
        tqdm.write(f"left out: {reason}")
    left = [run for run, found in states if found.state in ("missing", "interrupted", "failed")]
    return left, unreadable


def record_failure(run: ExperimentConfig, reason: str) -> None:
    """Write the reason of a failure and the last lines of the output into the run's folder."""
    failure = {"reason": reason, "when": now(), "log": _log_lines(run)[-LOG_LINES:]}
    write_text(run.folder / FAILURE_FILE, json.dumps(failure, indent=2) + "\n")


def _log_lines(run: ExperimentConfig) -> list[str]:
    path = run.folder / LOG_FILE
    return path.read_text(errors="replace").splitlines() if path.exists() else []


def _report_skipped(run: ExperimentConfig, process: str) -> None:
    tqdm.write(f"skipped: {process} runs the experiment in {run.folder}")


class _Job:
    """A run in a separate process."""

    def __init__(
        self, run: ExperimentConfig, worker: Sequence[str], max_hours: float | None
    ) -> None:
        self.run = run
        self._deadline = math.inf if max_hours is None else time.monotonic() + 3600 * max_hours
        self._kill_at = math.inf
        self._first: tuple[float, int] | None = None
        """Time and update at the first reading of the run's scalars."""
        self._timed_out = False
        run.folder.mkdir(parents=True, exist_ok=True)
        (run.folder / FAILURE_FILE).unlink(missing_ok=True)
        with (run.folder / LOG_FILE).open("a") as log:
            self._process = subprocess.Popen(
                [*worker, str(run.folder), str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                start_new_session=True,  # a group that is ended as a whole, with its environments
            )
        try:
            with self._process.stdin as stdin:
                pickle.dump(run, stdin)
        except BrokenPipeError:
            pass  # it ended before it read; its exit status is the reason

    def __str__(self) -> str:
        return f"{self.run.task} {self.run.label} seed {self.run.seed}"

    def progress(self) -> str:
        """Return the latest logged update, the estimated time of the others, and the run."""
        updates = last_step(self.run.folder)
        if updates is None:
            return str(self)
        total, seen = self.run.total_updates, (time.monotonic(), updates)
        self._first = self._first or seen
        start, first = self._first
        left = ""
        if updates > first:
            seconds = (seen[0] - start) / (updates - first) * (total - updates)
            left = f", {tqdm.format_interval(seconds)} left"
        return f"update {updates}/{total}{left}: {self}"

    def has_ended(self) -> bool:
        """Whether the process has ended.

        A process that exceeds its time limit is asked to end here, and one that does not save its
        state in time is killed with its child processes.
        """
        seen = time.monotonic()
        if seen > self._deadline:
            self._timed_out = True
            self.terminate()
        if self._process.poll() is None and seen > self._kill_at:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        return self._process.poll() is not None

    def close(self) -> str | None:
        """Record how the process ended; return the reason of a failure, None otherwise."""
        code = self._process.returncode
        if status(self.run).state == "done":
            return None
        holder = run_holder(self.run.folder)
        if holder is not None and not holder.startswith(f"process {self._process.pid} "):
            _report_skipped(self.run, holder)  # which started at the same time
            return None
        reason = f"exit status {code}"
        if self._timed_out:
            reason = "took longer than max_hours"
        elif code < 0:
            reason = f"killed by {signal.Signals(-code).name}"
        lines = _log_lines(self.run)
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        if code > 0 and last:
            reason += f": {last}"
        record_failure(self.run, reason)
        return reason

    def terminate(self) -> None:
        """Ask the process, once, to save its state and end."""
        if self._kill_at == math.inf and self._process.poll() is None:
            self._kill_at = time.monotonic() + SAVE_S
            self._process.terminate()
