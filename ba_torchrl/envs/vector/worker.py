"""The parent process's handle of a worker process of a vector of environments."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import pickle
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from multiprocessing import util
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from queue import SimpleQueue
from typing import Any, NamedTuple

import torchrl
from torch import multiprocessing as mp
from typing_extensions import Self

from ba_torchrl.errors import ConfigError, WorkerError
from ba_torchrl.sim.world import SIMULATOR_ERRORS

logger = logging.getLogger(__name__)

_IDLE_TIMEOUT_S = 1e6  # by default TorchRL's workers end after 10,000 s without a command
_PR_SET_PDEATHSIG = 1
_BUSY_WAIT_S = 100e-6
_POLL_INTERVAL_S = 30e-6


class EnvironmentRaisedError(WorkerError):
    """The environment of a worker raised an exception, or the process ended by an exception before
    it could make the environment; in contrast to a process that was ended."""


class SentError(NamedTuple):
    """An exception on its way to the parent process."""

    pickled: bytes
    """The exception; empty if it cannot be pickled."""
    summary: str
    """Its type and message."""
    text: str
    """Its traceback."""

    @classmethod
    def of(cls, error: BaseException) -> Self:
        """Return an exception of this process."""
        try:
            pickled = pickle.dumps(error)
        except Exception:  # whatever the methods of its class raise
            pickled = b""
        summary = f"{type(error).__name__}: {error}"
        return cls(pickled, summary, "".join(traceback.format_exception(error)))

    def received(self) -> Exception:
        """Return the exception, whose cause is an `EnvironmentRaisedError` with the traceback.

        It is a RuntimeError if this process cannot make one of that type, or that would end it.
        """
        try:
            error = pickle.loads(self.pickled)
        except Exception:  # whatever the methods of its class raise, or there is no such class
            error = None
        if not isinstance(error, Exception):
            error = RuntimeError(self.summary)
        error.__cause__ = EnvironmentRaisedError(f"it raised\n{self.text}")
        return error


def is_of_code(error: Exception) -> bool:
    """Return whether an error would occur again in a new process.

    Those of the simulator and of the machine's memory may not.

    Args:
        error: of an environment.
    """
    return not isinstance(error, (*SIMULATOR_ERRORS, WorkerError, MemoryError))


class Worker:
    """A process that runs one of TorchRL's worker loops, and the pipe to it.

    It has the interface of a pipe, which TorchRL expects, and stores the last command. Reading from
    a broken pipe raises a `WorkerError`.

    Args:
        loop: TorchRL's worker loop.
        options: keyword arguments of ``loop``, except the two ends of the pipe and the event.
        start_method: "spawn" or "fork"; None for the default of this process.
        timeout_s: seconds to wait for an answer.
        start_timeout_s: seconds to wait until the environment is built.
    """

    def __init__(
        self,
        loop: Callable[..., None],
        options: dict[str, Any],
        start_method: str | None,
        timeout_s: float,
        start_timeout_s: float,
    ) -> None:
        context = mp.get_context(start_method)
        self.pipe, child_pipe = context.Pipe()
        self.event = context.Event()
        self.message: tuple[Any, Any] = ("start", None)
        self.muted = False  # commands are dropped, because the episode is lost
        self._timeout_s, self._start_timeout_s = timeout_s, start_timeout_s
        options = {
            **options,
            "parent_pipe": self.pipe,
            "child_pipe": child_pipe,
            "mp_event": self.event,
        }
        self.is_ready = False
        """Whether the environment is built, and the worker takes commands."""
        self.process = context.Process(
            target=_run_worker, args=(loop, options, os.getpid()), daemon=True
        )
        start_process(self.process)
        self._start_deadline = time.monotonic() + start_timeout_s
        # At the end of this process, before multiprocessing sends SIGTERM, which workers ignore.
        self._at_exit = util.Finalize(self, _kill, (self.process,), exitpriority=10)
        child_pipe.close()  # else the pipe stays open when the worker ends

    @property
    def command(self) -> str:
        """The name of the last command."""
        return self.message[0]

    def has_started_or_failed(self) -> bool:
        """Whether `wait_until_ready` returns or raises at once."""
        is_late = time.monotonic() > self._start_deadline
        return is_late or self.process.exitcode is not None or self.pipe.poll()

    def wait_until_ready(self) -> None:
        """Wait until the environment is built.

        Raises:
            WorkerError: the environment is not built within ``start_timeout_s`` seconds after the
                start, or the process has ended.
            EnvironmentRaisedError: its constructor raised.
        """
        left_s = max(self._start_deadline - time.monotonic(), 0.0)
        self.read(left_s, limit_s=self._start_timeout_s)
        self.is_ready = True
        self.send(("init", None))

    def send(self, message: tuple[Any, Any]) -> None:
        """Send a command and its argument; if the worker has ended, reading the answer raises.

        Raises:
            WorkerError: the environment is not built yet.
        """
        self.message = message
        if self.muted:
            return
        if not self.is_ready:
            raise WorkerError(f"it cannot take {self.command!r} while it starts")
        try:
            # Not `send`, which passes tensors as file descriptors that an ended worker never opens.
            self.pipe.send_bytes(pickle.dumps(message, pickle.HIGHEST_PROTOCOL))
        except OSError as error:
            logger.debug("could not send %r: %s", message[0], error)

    def recv(self) -> Any:
        """Return the next answer.

        Raises:
            WorkerError: the worker failed.
        """
        return self.read(self._timeout_s)

    def read(self, timeout_s: float, *, limit_s: float | None = None) -> Any:
        """Return the next message of the pipe.

        Args:
            timeout_s: seconds to wait.
            limit_s: the limit that the error names; by default ``timeout_s``.

        Raises:
            WorkerError: the worker has ended, or sends nothing for ``timeout_s`` seconds.
            EnvironmentRaisedError: the simulator or the machine failed, or the environment cannot
                be made.
            Exception: any other error of the environment, with its traceback as the cause; in a new
                process it would occur again.
        """
        try:
            if not self.pipe.poll(timeout_s):
                limit_s = timeout_s if limit_s is None else limit_s
                raise WorkerError(f"it did not answer {self.command!r} within {limit_s:g} s")
            message = self.pipe.recv()
        except (EOFError, OSError):
            reason = self._exit_reason()
            # `_run_worker` sends every exception: this one was raised before, by an import
            if not self.is_ready and (self.process.exitcode or 0) > 0:
                raise EnvironmentRaisedError(
                    f"{reason} before it made the environment. It cannot import what it needs, see "
                    'its traceback above, or the script lacks `if __name__ == "__main__":`'
                ) from None
            raise WorkerError(reason) from None
        if isinstance(message, SentError):
            error = message.received()
            is_final = isinstance(error, ConfigError) or (self.is_ready and is_of_code(error))
            raise error if is_final else error.__cause__
        return message

    def check(self) -> None:
        """Drop answers to earlier commands, and check that the worker runs.

        Raises:
            WorkerError: the worker has ended.
        """
        while self.process.exitcode is not None or self.pipe.poll():
            self.read(0.0)

    def join(self, timeout_s: float) -> None:
        """Wait until the process ends, kill it after the timeout, and release its resources."""
        self.process.join(max(timeout_s, 0.0))
        self.kill()

    def abort(self) -> None:
        """Kill the process; the next `check` raises."""
        self.process.kill()  # a hanging simulator ignores other signals
        self.process.join()

    def kill(self) -> None:
        """Kill the process and release its resources."""
        self._at_exit.cancel()
        self.abort()
        self.process.close()
        self.pipe.close()

    def _exit_reason(self) -> str:
        self.process.join(1.0)
        code = self.process.exitcode
        if code is None:
            return "it closed its pipe"
        if code >= 0:
            return f"its process ended with exit code {code}"
        return f"its process was ended by {signal.Signals(-code).name}"


def _kill(process: BaseProcess) -> None:
    process.kill()
    process.join()


def end_with(parent: int) -> None:
    """Let the kernel kill this process when its parent ends, even if it hangs or is stopped.

    Args:
        parent: process id of the parent, whose main thread started this process.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it ended before
            os._exit(1)


def _run_worker(loop: Callable[..., None], options: dict[str, Any], parent: int) -> None:
    """Run TorchRL's loop in a worker process, and send its exception to the parent."""
    end_with(parent)
    # The parent handles the signals that a scheduler or a terminal sends to all processes, saves
    # its state with the workers' help and ends them.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    torchrl._utils.BATCHED_PIPE_TIMEOUT = _IDLE_TIMEOUT_S
    pipe: Connection = options["child_pipe"]
    try:
        loop(**options)
    except BaseException as error:
        with contextlib.suppress(OSError):  # the parent has ended
            pipe.send(SentError.of(error))
        os._exit(1)  # skip the clean-up of the failed environment


def wait_until(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Poll ``condition``, first by busy waiting; return whether it holds before the timeout."""
    start = time.perf_counter()
    while not condition():
        elapsed = time.perf_counter() - start
        if elapsed > timeout_s:
            return False
        if elapsed > _BUSY_WAIT_S:
            time.sleep(_POLL_INTERVAL_S)  # free the core for the workers
    return True


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
