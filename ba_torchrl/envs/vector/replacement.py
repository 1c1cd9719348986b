"""Replacement of failed workers, while the other workers continue."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing.connection import wait

import numpy as np

from ba_torchrl.envs.vector.worker import Worker
from ba_torchrl.errors import WorkerError

logger = logging.getLogger(__name__)


@dataclass
class _Start:
    """A worker that starts.

    Args:
        seed: of its environment; None for an unused one.
        failures: number of attempts that failed.
    """

    seed: int | None
    failures: int


class Replacements:
    """Replaces failed workers, and ends their vector after too many failures in a row.

    Args:
        workers: by index; failed ones are replaced in this list.
        launch: starts worker ``index`` without waiting for it.
        give_up: called before an error of too many failures.
        max_restarts: largest number of failures in a row of a worker: of attempts to start it, or
            of resets and steps without a completed step.
        num_workers: length of ``workers`` when all are started.
    """

    def __init__(
        self,
        workers: list[Worker],
        launch: Callable[[int], Worker],
        give_up: Callable[[], None],
        max_restarts: int,
        num_workers: int,
    ) -> None:
        self._workers = workers
        self._launch = launch
        self._give_up = give_up
        self.max_restarts = max_restarts
        self.restarts = 0
        """Number of replacements."""
        self.base_seed: int | None = None
        """From which the seeds of replaced workers are derived; None for random ones."""
        self._starts: dict[int, _Start] = {}
        self._failures_in_a_row = [0] * num_workers
        self._since_seed = [0] * num_workers

    @property
    def starting(self) -> frozenset[int]:
        """Indices of the workers that do not take commands yet."""
        return frozenset(self._starts)

    def begin(
        self, causes: Mapping[int, WorkerError], seed: int | None = None, failures: int = 0
    ) -> None:
        """Start new processes in place of failed workers, without waiting for them.

        Args:
            causes: why each worker is replaced, by index.
            seed: of the environment; None for an unused one.
            failures: number of failed attempts to start the worker.

        Raises:
            RuntimeError: there were too many.
        """
        for index, cause in causes.items():
            self._check_limit(index, failures, "starting", cause)
            self.restarts += 1
            self._since_seed[index] += 1
            # As text: the traceback in a stored log record would keep the ended worker alive.
            logger.warning(
                "worker %d is replaced (restart %d): %s", index, self.restarts, str(cause)
            )
            self._workers[index].kill()
            self._workers[index] = self._launch(index)
            self._starts[index] = _Start(seed, failures)

    def finish(self, *, wait_for_all: bool) -> None:
        """Seed the environments of the new workers that are ready; they must be reset.

        Args:
            wait_for_all: wait until every worker is ready.

        Raises:
            RuntimeError: too many attempts to start a worker failed.
        """
        while self._starts:
            is_any = False
            for index, start in tuple(self._starts.items()):
                worker = self._workers[index]
                if not (wait_for_all or worker.has_started_or_failed()):
                    continue
                is_any = True
                try:
                    worker.wait_until_ready()
                    seed_worker(worker, self._new_seed(index) if start.seed is None else start.seed)
                    del self._starts[index]
                except WorkerError as error:
                    self.begin({index: error}, start.seed, start.failures + 1)
            if not (wait_for_all or is_any):
                return

    def forget_starts(self) -> None:
        """Note that all workers have ended."""
        self._starts.clear()

    def wait_for_any(self, timeout_s: float) -> None:
        """Wait until a worker that starts is ready or has ended, at most ``timeout_s`` seconds."""
        wait([self._workers[index].pipe for index in self._starts], timeout_s)

    def count_failure(self, index: int, cause: WorkerError) -> None:
        """Count a failure in a reset or a step.

        Raises:
            RuntimeError: there were too many without a completed step.
        """
        self._failures_in_a_row[index] += 1
        self._check_limit(index, self._failures_in_a_row[index], "completing a step", cause)

    def count_step(self, index: int) -> None:
        """Note that a worker completed a step."""
        self._failures_in_a_row[index] = 0

    def on_seed(self, index: int) -> None:
        """Note that the environment of a worker was seeded anew."""
        self._since_seed[index] = 0

    def _new_seed(self, index: int) -> int:
        """Return an unused seed, which is the same in every repetition of the run."""
        known = self.base_seed is not None
        entropy = [self.base_seed, index, self._since_seed[index]] if known else None
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])

    def _check_limit(self, index: int, failures: int, success: str, cause: WorkerError) -> None:
        if failures <= self.max_restarts:
            return
        self._give_up()
        raise RuntimeError(
            f"worker {index} failed {failures} times without {success}; the last time {cause}. All "
            "workers were closed. Use parallel=False to see the error where it happens, or raise "
            "timeout_s, start_timeout_s or max_restarts"
        )


def seed_worker(worker: Worker, seed: int) -> None:
    """Seed the environment of a worker.

    Raises:
        WorkerError: the worker has failed.
    """
    worker.send(("seed", (seed, True)))
    worker.recv()
