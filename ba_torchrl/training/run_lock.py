"""The lock on a run folder, which one process at a time holds (POSIX systems)."""

from __future__ import annotations

import fcntl
import os
import socket
from pathlib import Path

from ba_torchrl.errors import ConfigError

LOCK_FILE = "run.lock"


class RunLock:
    """Locks a run folder until `release` or the end of the process.

    Args:
        folder: of the run, which is created if needed.

    Raises:
        ConfigError: another process holds the lock; the message names it.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = (folder / LOCK_FILE).open("a+")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise ConfigError(f"{lock_holder(folder)} runs the experiment in {folder}") from None
        self._file.truncate(0)
        self._file.write(f"process {os.getpid()} on {socket.gethostname()}")
        self._file.flush()

    def release(self) -> None:
        """Unlock the folder; further calls have no effect."""
        self._file.close()


def lock_holder(folder: Path) -> str | None:
    """Return the process that runs the experiment in a folder, such as "process 12 on a-host".

    None if there is none.
    """
    try:
        with (folder / LOCK_FILE).open() as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return file.read() or "another process"
    except FileNotFoundError:
        pass
    return None
