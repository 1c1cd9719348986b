"""Collectors with worker processes on this machine, which TorchRL runs."""

from __future__ import annotations

import contextlib
import copy
import logging
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from multiprocessing.process import BaseProcess
from multiprocessing.queues import SimpleQueue
from queue import Empty
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import multiprocessing as mp
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.weight_update import MultiProcessWeightSyncScheme

from ba_torchrl.core.processes import end_with
from ba_torchrl.envs.episode_positions import EpisodePosition
from ba_torchrl.envs.vector.worker import SentError, is_of_code
from ba_torchrl.training.collectors.base import CollectionProblem
from ba_torchrl.training.collectors.config import WorkersConfig
from ba_torchrl.training.collectors.multi_config import MultiAsyncConfig, MultiSyncConfig
from ba_torchrl.training.collectors.workers import WorkerCollection, failed_too_often

logger = logging.getLogger(__name__)

_SHUTDOWN_S = 2.0
_HEALTH_CHECK_S = 0.5
# ValueError: TorchRL closes the other processes, which ignore its SIGTERM
_OF_WORKERS = (RuntimeError, OSError, EOFError, ValueError)
"""Errors of TorchRL's collector when a worker ends or does not start."""


def start_sync(
    config: MultiSyncConfig, problem: CollectionProblem, _: Sequence[EpisodePosition] | None
) -> MultiCollection:
    """Start to collect; see `CollectorConfig.start`. The environments start new episodes."""
    frames = config.steps_per_batch * problem.num_envs
    return MultiCollection(problem, config, MultiSyncCollector, frames)


def start_async(
    config: MultiAsyncConfig, problem: CollectionProblem, _: Sequence[EpisodePosition] | None
) -> MultiCollection:
    """Start to collect; see `CollectorConfig.start`. The environments start new episodes."""
    frames = config.steps_per_batch * problem.num_envs // config.workers
    return MultiCollection(problem, config, _AsyncCollector, frames)


class MultiCollection(WorkerCollection):
    """Batches of worker processes: of all workers if they are synchronous, else of one of them.

    If a worker process ends, all are replaced, and their episodes in progress are lost. An error of
    the code in a worker, such as a task's, is raised instead.
    """

    def __init__(
        self,
        problem: CollectionProblem,
        config: WorkersConfig,
        collector_class: type[MultiSyncCollector | MultiAsyncCollector],
        frames: int,
    ) -> None:
        super().__init__(problem, config)
        self._collector_class = collector_class
        self._frames = frames
        self._restarts = 0
        self._failures_in_a_row = 0
        self._collector = self._start()
        self._batches = iter(self._collector)

    @property
    def worker_pids(self) -> list[int]:
        """Process ids of the workers."""
        return [process.pid for process in self._collector.procs]

    def collect(self) -> TensorDict:
        weights = self.weights()
        while True:
            try:
                with _killed_after(self._patience_s, lambda: self._collector.procs):
                    self._collector.update_policy_weights_(weights)
                    batch = next(self._batches)
            except _OF_WORKERS as error:
                self._replace(error)
                continue
            self._failures_in_a_row = 0
            self._patience_s = self.problem.workers.timeout_s
            return batch

    def close(self) -> None:
        threads = torch.get_num_threads()
        self._collector.shutdown(timeout=_SHUTDOWN_S, raise_on_error=False)
        torch.set_num_threads(threads)  # TorchRL increases the number
        _kill(self._collector.procs)  # those that do not end in time
        self._weight_sync.shutdown()  # at the interpreter's exit, TorchRL would wait forever

    def _start(self) -> MultiSyncCollector | MultiAsyncCollector:
        problem = self.problem
        workers = problem.workers
        self._patience_s = workers.start_timeout_s + workers.timeout_s  # until the first batch
        # A worker is killed when the thread that started it ends, so only for the main thread.
        is_main = threading.current_thread() is threading.main_thread()
        self._errors = mp.get_context(workers.start_method).SimpleQueue()
        self._weight_sync = _WeightSync()
        before = {*mp.active_children()}

        def started() -> set[BaseProcess]:
            return {*mp.active_children()} - before

        try:
            with _start_method(workers.start_method), _killed_after(self._patience_s, started):
                return self._collector_class(
                    self.make_envs(problem.make_env, self._restarts),
                    # TorchRL sends its weights at first, and moves them to shared memory.
                    policy=copy.deepcopy(self.policy).to("cpu"),
                    policy_factory=self.make_policies(self._restarts),
                    collector_class=partial(_WorkersCollector, errors=self._errors),
                    frames_per_batch=self._frames,
                    total_frames=-1,
                    storing_device="cpu",
                    weight_sync_schemes={"policy": self._weight_sync},
                    num_threads=torch.get_num_threads(),
                    auto_register_policy_transforms=False,
                    init_fn=partial(_prepare_worker, os.getpid() if is_main else None),
                )
        except BaseException:
            _kill(started())
            self._weight_sync.shutdown()
            raise

    def _replace(self, cause: Exception) -> None:
        """Replace the workers after a failure.

        Raises:
            RuntimeError: there were too many in a row, with those at the start of new workers.
            Exception: a worker sent it, and it would occur again in a new process.
        """
        self.close()
        if not self._errors.empty():
            error = self._errors.get().received()
            if is_of_code(error):
                raise error
            cause = error.__cause__
        self._failures_in_a_row += 1
        if self._failures_in_a_row > self.problem.workers.max_restarts:
            raise failed_too_often(self._failures_in_a_row, cause) from cause
        self.count_restart(cause)
        self._restarts += 1
        logger.warning("workers are replaced (restart %d): %s", self._restarts, cause)
        try:
            self._collector = self._start()
        except _OF_WORKERS as error:
            self._replace(error)
            return
        self._batches = iter(self._collector)


class _WorkersCollector(Collector):
    """TorchRL's collector in a worker process, which sends its error to the parent.

    Args:
        errors: where to.
    """

    def __init__(self, *args: Any, errors: SimpleQueue[SentError], **options: Any) -> None:
        super().__init__(*args, **options)
        self._errors = errors

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yield batches."""
        try:
            yield from super().iterator()
        except Exception as error:
            self._errors.put(SentError.of(error).shortened())
            raise


class _AsyncCollector(MultiAsyncCollector):
    """TorchRL's collector with a place in the queue for each worker's batch.

    TorchRL's queue has one place, and its workers discard a batch that finds none for a second.
    """

    @property
    def _queue_len(self) -> int:
        return self.num_workers


class _WeightSync(MultiProcessWeightSyncScheme):
    """TorchRL's scheme, which notices that a worker ended instead of waiting for it forever."""

    def _wait_for_ack(
        self, worker_ids: int | list[int] | None = None, timeout: float | None = None
    ) -> None:
        """Wait until all workers have the weights.

        Raises:
            RuntimeError: a worker has ended.
        """
        for queue in self._ack_queues.values():
            is_waiting = True
            while is_waiting:
                try:
                    queue.get(timeout=_HEALTH_CHECK_S)
                    is_waiting = False
                except Empty:
                    if not all(process.is_alive() for process in self.context.procs):
                        raise RuntimeError("a worker process has ended") from None


def _prepare_worker(parent: int | None) -> None:
    """Leave signals to the learner's process, and end with it."""
    if parent is not None:
        end_with(parent)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def _kill(processes: Iterable[BaseProcess], *, and_wait: bool = True) -> None:
    for process in processes:
        with contextlib.suppress(ValueError):  # TorchRL has closed it
            process.kill()
            if and_wait:
                process.join()


@contextlib.contextmanager
def _killed_after(seconds: float, find: Callable[[], Iterable[BaseProcess]]) -> Iterator[None]:
    """Context that kills the processes found when it takes too long; TorchRL waits for those that
    hang, and notices an end within a second."""

    def kill() -> None:
        logger.warning("workers did not answer for %g s and are killed", seconds)
        _kill(find(), and_wait=False)

    timer = threading.Timer(seconds, kill)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()  # a process that is forked must not inherit its locks


@contextlib.contextmanager
def _start_method(method: str) -> Iterator[None]:
    """Context in which processes start as ``method`` says, TorchRL's included."""
    before = mp.get_start_method(allow_none=True)
    mp.set_start_method(method, force=True)
    try:
        yield
    finally:
        mp.set_start_method(before, force=True)
