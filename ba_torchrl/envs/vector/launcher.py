"""Start of worker processes from a thread that does not end before this process."""

from __future__ import annotations

import threading
from concurrent.futures import Future
from multiprocessing.process import BaseProcess
from queue import SimpleQueue


def start_process(process: BaseProcess) -> None:
    """Start a worker process.

    Linux kills a worker when the thread that started it ends (``PR_SET_PDEATHSIG``), which is the
    end of this process only for the main thread. On behalf of other threads, a thread that never
    ends starts the process.

    Args:
        process: not started yet.

    Raises:
        OSError: the process cannot be started.
    """
    if threading.current_thread() is threading.main_thread():
        process.start()
        return
    global _launcher
    with _lock:
        if _launcher is None or not _launcher.is_alive():  # no thread survives a fork
            _launcher = _Launcher()
            _launcher.start()
    _launcher.start_process(process)


class _Launcher(threading.Thread):
    """A thread that starts processes."""

    def __init__(self) -> None:
        super().__init__(name="worker launcher", daemon=True)
        self._requests: SimpleQueue[tuple[BaseProcess, Future[None]]] = SimpleQueue()

    def start_process(self, process: BaseProcess) -> None:
        """Start a process in this thread, and wait until it is started."""
        started: Future[None] = Future()
        self._requests.put((process, started))
        started.result()

    def run(self) -> None:
        """Serve requests until the process ends."""
        while True:
            process, started = self._requests.get()
            try:
                process.start()
            except BaseException as error:  # raised in the thread that asked
                started.set_exception(error)
            else:
                started.set_result(None)


_launcher: _Launcher | None = None
_lock = threading.Lock()
