"""Stopping a run by a signal: it ends between two updates, with its state saved."""

from __future__ import annotations

import logging
import shlex
import signal
import threading
from pathlib import Path
from types import FrameType

from torchrl.envs import EnvBase
from typing_extensions import Self

from ba_torchrl.core.errors import SimulationError, WorkerError
from ba_torchrl.envs.episode_positions import EpisodePosition

logger = logging.getLogger(__name__)

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption(BaseException):
    """Raised inside a run where it can stop; `Experiment.run` turns it into `RunStopped`."""


class RunStopped(SystemExit):
    """A signal ended the run; the message says what was saved. The exit code is 128 + signal."""

    def __init__(self, message: str, signum: int) -> None:
        super().__init__(128 + signum)
        self.message = message

    def __str__(self) -> str:
        return self.message


class StopSignals:
    """Context in which SIGINT and SIGTERM are noted for `check`.

    A second SIGINT has its usual effect; further SIGTERMs, which schedulers repeat, have none.
    Outside the main thread, where Python allows no handlers, signals are left alone.
    """

    def __init__(self) -> None:
        self._received: int | None = None
        self._before: dict[int, object] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._note) for number in STOP_SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def check(self) -> None:
        """Raise `Interruption` if a signal was received."""
        if self._received is not None:
            raise Interruption

    def stopped(self, is_saved: bool, folder: Path) -> RunStopped:
        """Return the exception that ends the process."""
        name = signal.Signals(self._received).name
        what = "state saved" if is_saved else "nothing to save yet"
        command = shlex.join(["ba-torchrl", "train", f"run_dir={folder}", "resume=true"])
        return RunStopped(f"stopped by {name}, {what}: {command} continues", self._received)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._received is None:
            self._received = number
        elif number == signal.SIGTERM:
            return
        signal.signal(signal.SIGINT, self._before[signal.SIGINT])

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}


def positions_of(env: EnvBase) -> list[EpisodePosition] | None:
    """Return the positions of a run's environments, None if one has failed."""
    if env.is_closed:
        return None
    try:
        return env.get_positions()
    except (SimulationError, WorkerError) as error:
        logger.warning("saved without the episodes in progress: %s", error)
        return None
