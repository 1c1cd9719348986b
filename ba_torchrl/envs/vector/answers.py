"""Waiting for the answers of worker processes."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import Array, c_byte
from multiprocessing.connection import wait
from typing import Any

from ba_torchrl.envs.vector.worker import Worker, wait_until
from ba_torchrl.errors import WorkerError

_HEALTH_CHECK_S = 5e-3


def collect_flags(
    workers: Sequence[Worker], pending: set[int], flags: Array[c_byte]
) -> dict[int, WorkerError]:
    """Wait briefly for workers that answer through shared memory.

    Args:
        workers: all workers.
        pending: indices of those that have not answered; those that answer are removed.
        flags: set by the workers.

    Returns:
        The errors of ended workers, by index.
    """

    def all_answered() -> bool:
        for index in tuple(pending):
            if flags[index]:
                flags[index] = 0
                pending.discard(index)
        return not pending

    failures: dict[int, WorkerError] = {}
    if wait_until(all_answered, _HEALTH_CHECK_S):
        return failures
    for index in pending:
        try:
            workers[index].check()
        except WorkerError as error:
            if not flags[index]:  # else it answered before it ended
                failures[index] = error
    return failures


def collect_messages(workers: Sequence[Worker], pending: set[int]) -> dict[int, WorkerError]:
    """As `collect_flags`, for workers that answer through pipes."""
    failures: dict[int, WorkerError] = {}
    pipes = {workers[index].pipe: index for index in pending}
    for pipe in wait(list(pipes), _HEALTH_CHECK_S):
        worker = workers[pipes[pipe]]
        try:
            worker.inbox.append(worker.read(0.0))  # TorchRL reads it from the inbox
            pending.discard(pipes[pipe])
        except WorkerError as error:
            failures[pipes[pipe]] = error
    return failures


def ask_all(
    workers: Sequence[Worker], method: str, arguments: Sequence[tuple[Any, ...]], timeout_s: float
) -> list[Any]:
    """Call a method of every worker's environment and return the results.

    Args:
        workers: all workers.
        method: name of the method.
        arguments: of each worker's call.
        timeout_s: seconds to wait for each answer.

    Raises:
        WorkerError: a worker has failed.
    """
    for worker, args in zip(workers, arguments, strict=True):
        worker.check()
        worker.send((method, (args, {})))
    results, failure = [], None
    for worker in workers:
        try:
            results.append(worker.read(timeout_s)[1])
        except WorkerError as error:
            worker.abort()  # a late answer would be taken for that to the next command
            failure = error
    if failure is not None:
        raise failure
    return results
