"""A process that runs one environment of a vector, and the parent's handle of it."""

from __future__ import annotations

import os
import pickle
import signal
import socket
import struct
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from multiprocessing import resource_tracker, util
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import multiprocessing as mp
from torchrl.data import NonTensor
from typing_extensions import Self

from ba_torchrl.core.config import WorkerOptions
from ba_torchrl.core.errors import ConfigError, RepeatedFaultError, WorkerError
from ba_torchrl.core.processes import end_with
from ba_torchrl.envs.vector.batching import MakeEnv
from ba_torchrl.sim.world import SIMULATOR_ERRORS

T = TypeVar("T")
Slot = tuple[TensorDictBase, TensorDictBase]


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
        name = type(error).__name__
        summary = _attempt(lambda: f"{name}: {error}", f"{name}, which cannot be printed")
        text = _attempt(lambda: "".join(traceback.format_exception(error)), summary)
        return cls(_attempt(lambda: pickle.dumps(error), b""), summary, text)

    def shortened(self) -> Self:
        """Return it with less than 64 KiB, which a pipe holds while nobody reads.

        A large exception arrives as its summary.
        """

        def part(text: str, half: int) -> str:
            return text if len(text) <= 2 * half else f"{text[:half]} ... {text[-half:]}"

        pickled = self.pickled if len(self.pickled) < 2**13 else b""
        return type(self)(pickled, part(self.summary, 2**10), part(self.text, 2**12))

    def received(self) -> Exception:
        """Return the exception, whose cause is an `EnvironmentRaisedError` with the traceback.

        It is a RuntimeError if this process cannot make one of that type, or that would end it.
        """
        cause = EnvironmentRaisedError(f"it raised\n{self.text}")
        error = _attempt(lambda: _caused(pickle.loads(self.pickled), cause), None)
        return error if isinstance(error, Exception) else _caused(RuntimeError(self.summary), cause)


def _attempt(function: Callable[[], T], default: T) -> T:
    """Return a result, or a default if the class of an author's exception lets it fail."""
    try:
        return function()
    except Exception:
        return default


def _caused(error: Exception, cause: Exception) -> Exception:
    error.__cause__ = cause
    return error


def is_of_code(error: Exception) -> bool:
    """Return whether an error would occur again in a new process.

    Those of the simulator and of the machine's memory may not, unless they are repeated.
    """
    if isinstance(error, RepeatedFaultError):
        return True
    return not isinstance(error, (*SIMULATOR_ERRORS, WorkerError, MemoryError))


class Worker:
    """The parent's handle of a process that runs one environment.

    A command is the name of a method of `_Member` and its arguments, as bytes in a pipe, and has
    one answer. Observations, rewards and flags are in shared memory.

    Args:
        slot: TensorDicts in shared memory: action and state; observation, reward and flags.
        options: how the process starts, and its time limits.
    """

    def __init__(self, make_env: MakeEnv, slot: Slot, options: WorkerOptions) -> None:
        context = mp.get_context(options.start_method)
        self.pipe, child_pipe = context.Pipe()
        _limit_sending(self.pipe, options.timeout_s)
        self.process = context.Process(
            # A function that cannot be imported is met first, so that the pipe is open until the
            # process has ended.
            target=_run,
            args=(make_env, slot, child_pipe, self.pipe, os.getpid()),
            daemon=True,
        )
        start_process(self.process)
        child_pipe.close()  # else the pipe stays open when the process ends
        self._start_timeout_s = options.start_timeout_s
        self._start_deadline = time.monotonic() + options.start_timeout_s
        self._is_ready = False
        # At the end of this process, before multiprocessing sends SIGTERM, which workers ignore.
        self._at_exit = util.Finalize(self, _kill, (self.process,), exitpriority=10)
        self.send("make", (), {})

    def has_started_or_failed(self) -> bool:
        """Whether `wait_until_ready` returns or raises at once."""
        return time.monotonic() > self._start_deadline or self.has_answer()

    def wait_until_ready(self) -> None:
        """Wait until the environment is made.

        Raises:
            WorkerError: it is not made within ``start_timeout_s`` seconds after the start, or the
                process has ended.
            EnvironmentRaisedError: its constructor raised, or what it needs cannot be imported.
            ConfigError: its constructor raised it; in a new process it would again.
        """
        if not self.pipe.poll(max(self._start_deadline - time.monotonic(), 0.0)):
            raise WorkerError(f"it did not start within {self._start_timeout_s:g} s")
        self.receive()
        self._is_ready = True

    @property
    def handles(self) -> tuple[Connection, int]:
        """What `multiprocessing.connection.wait` waits for: an answer, the end of the process."""
        return self.pipe, self.process.sentinel

    def send(self, command: str, arguments: tuple[Any, ...], keywords: dict[str, Any]) -> None:
        """Send a command; if the process has ended, `receive` raises. One that does not take the
        command within ``timeout_s`` seconds, since its pipe is full, is killed."""
        try:
            # Not `send`, which passes tensors as file descriptors that an ended worker never opens.
            self.pipe.send_bytes(pickle.dumps((command, arguments, keywords)))
        except BlockingIOError:
            self.abort()
        except OSError:
            pass

    def has_answer(self) -> bool:
        """Whether `receive` returns or raises at once."""
        return self.pipe.poll() or self.process.exitcode is not None

    def receive(self) -> Any:
        """Return the answer to the last command, which has arrived.

        Raises:
            WorkerError: the process has ended.
            EnvironmentRaisedError: the simulator or the machine failed, or the environment cannot
                be made.
            Exception: any other error of the environment, with its traceback as the cause; in a new
                process it would occur again.
        """
        try:
            if not self.pipe.poll():
                raise EOFError
            answer = pickle.loads(self.pipe.recv_bytes())
        except (EOFError, OSError):
            self._raise_exit()
        if isinstance(answer, SentError):
            error = answer.received()
            is_final = isinstance(error, ConfigError) or (self._is_ready and is_of_code(error))
            raise error if is_final else error.__cause__
        return answer

    def check(self) -> None:
        """Check that the process runs."""
        if self.process.exitcode is not None:
            self._raise_exit()

    def join(self, timeout_s: float) -> None:
        """Wait until the process ends, kill it after the timeout, and release its resources."""
        self.process.join(max(timeout_s, 0.0))
        self.kill()

    def abort(self) -> None:
        """Kill the process; the next `check` raises."""
        _kill(self.process)  # a hanging simulator ignores other signals

    def kill(self) -> None:
        """Kill the process and release its resources."""
        self._at_exit.cancel()
        self.abort()
        self.process.close()
        self.pipe.close()

    def _raise_exit(self) -> None:
        self.process.join(1.0)
        code = self.process.exitcode
        if code is None:
            raise WorkerError("it closed its pipe")
        if code < 0:
            raise WorkerError(f"its process was ended by {signal.Signals(-code).name}")
        reason = f"its process ended with exit code {code}"
        if self._is_ready or code == 0:
            raise WorkerError(reason)
        raise EnvironmentRaisedError(  # not by the environment, whose errors are answers
            f"{reason} before it made the environment. It cannot import what it needs, see its "
            'traceback above, or the script lacks `if __name__ == "__main__":`'
        )


class _Member:
    """The environment of a worker process. Its methods are the commands."""

    def __init__(self, make_env: MakeEnv, slot: Slot) -> None:
        self._make_env = make_env
        self._inputs, self._outputs = (dict(part.items(True, True)) for part in slot)

    def make(self) -> None:
        """Build the environment."""
        self.env = self._make_env()
        self._state: TensorDictBase = TensorDict({}, self.env.batch_size)
        spec = self.env.observation_spec
        self._texts = [key for key in spec.keys(True, True) if isinstance(spec[key], NonTensor)]

    def set_seed(self, seed: int | None, static_seed: bool) -> int | None:
        """Seed the environment and torch."""
        if seed is not None:
            torch.manual_seed(seed)
        return self.env.set_seed(seed, static_seed=static_seed)

    def reset(self, **options: Any) -> dict[Any, Any]:
        """Reset; return the entries that are no tensors."""
        return self._write(self.env.reset(**options))

    def step(self) -> dict[Any, Any]:
        """Step with the action in shared memory; return the entries that are no tensors."""
        state = self._state.copy()
        for key, value in self._inputs.items():
            state.set(key, value.clone())
        return self._write(self.env.step(state)["next"])

    def get(self, name: str) -> tuple[Any, bool]:
        """Return an attribute of the environment and False, or None and True for a method."""
        value = getattr(self.env, name)
        return (None, True) if callable(value) else (value, False)

    def call(self, method: str, *arguments: Any, **keywords: Any) -> Any:
        """Call a method of the environment."""
        return getattr(self.env, method)(*arguments, **keywords)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def _write(self, state: TensorDictBase) -> dict[Any, Any]:
        self._state = state
        for key, target in self._outputs.items():
            value = state.get(key, None)
            if value is not None:  # a reset has no reward
                target.copy_(value)
        return {key: state[key] for key in self._texts}


def _run(
    make_env: MakeEnv, slot: Slot, pipe: Connection, parent_pipe: Connection, parent: int
) -> None:
    """Execute commands in a worker process until it is closed or its parent has ended."""
    end_with(parent)
    # The parent handles the signals that a scheduler or a terminal sends to all processes, saves
    # its state with the workers' help and ends them.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    parent_pipe.close()
    torch.set_num_threads(1)
    member, command = _Member(make_env, slot), ""
    with suppress(EOFError, OSError):
        while command != "close":
            command, arguments, keywords = pickle.loads(pipe.recv_bytes())
            try:
                answer = pickle.dumps(getattr(member, command)(*arguments, **keywords))
            except BaseException as error:  # the parent raises it
                answer = pickle.dumps(SentError.of(error))
            pipe.send_bytes(answer)


def _limit_sending(pipe: Connection, seconds: float) -> None:
    """Let `send_bytes` raise BlockingIOError when a full pipe takes nothing for some time."""
    timeval = struct.pack("ll", int(seconds), int(seconds % 1 * 1e6))
    with socket.socket(fileno=os.dup(pipe.fileno())) as same:  # a pipe of two directions is one
        same.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, timeval)


def _kill(process: BaseProcess) -> None:
    process.kill()
    process.join()


def start_process(process: BaseProcess) -> None:
    """Start a worker process.

    Linux kills a worker when the thread that started it ends (``PR_SET_PDEATHSIG``), which is the
    end of this process only for the main thread. On behalf of other threads, a thread that never
    ends starts the process.
    """
    if threading.current_thread() is threading.main_thread():
        _start(process)
        return
    with _lock:
        launcher = _launcher(os.getpid())
    launcher.submit(_start, process).result()


def _start(process: BaseProcess) -> None:
    """Start a process, to which a terminal's signals do not come while it imports its modules."""
    if isinstance(process, SpawnProcess):
        resource_tracker.ensure_running()  # its own start unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@cache
def _launcher(pid: int) -> ThreadPoolExecutor:
    """Return the thread that starts processes of this process ``pid``; none survives a fork."""
    return ThreadPoolExecutor(1, "worker launcher")


_lock = threading.Lock()
