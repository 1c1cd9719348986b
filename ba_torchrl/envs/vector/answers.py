"""Waiting for the answers of worker processes."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import Array, c_byte
from typing import Any

from ba_torchrl.envs.vector.worker import Worker, wait_until
from ba_torchrl.errors import WorkerError

_HEALTH_CHECK_S = 5e-3


def collect_flags(
    workers: Sequence[Worker], pending: set[int], flags: Array[c_byte]
) -> dict[int, WorkerError]:
    """Wait briefly for the workers' answers, which are in shared memory.

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
