"""Files of a run that survive a loss of power: checkpoints, whose files are checked before they are
loaded, and the lock on the run folder, which one process at a time holds."""

from __future__ import annotations

import fcntl
import logging
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from torchrl.checkpoint import (
    Checkpoint,
    CheckpointAdapter,
    CheckpointError,
    CheckpointLoadResult,
)

from ba_torchrl.core.errors import ConfigError, DamagedFilesError
from ba_torchrl.core.files import (
    OLD,
    RENAMED,
    Lock,
    check,
    complete_only,
    read_state,
    seal,
    write_state,
)

logger = logging.getLogger(__name__)

LOCK_FILE = "run.lock"


class _StateAdapter(CheckpointAdapter):
    """Writes a component's ``state_dict`` with `write_state`."""

    adapter_id = "ba_torchrl.state.3"
    # 1: weights of kernels whose signs depended on the CPU; 2: images under other keys

    def save(self, component: Any, path: Path, **_: Any) -> None:
        write_state(path, component.state_dict())

    def load(self, component: Any, path: Path, **_: Any) -> None:
        component.load_state_dict(read_state(path))


class DurableCheckpoint(Checkpoint):
    """TorchRL's checkpoint as a folder of data that appears when it is complete on the disk.

    Args:
        components: what is saved, by name: each has ``state_dict`` and ``load_state_dict``.
    """

    def __init__(self, **components: Any) -> None:
        super().__init__()
        for name, component in components.items():
            self.register(name, component, adapter=_StateAdapter())

    def save(self, path: str | Path, **options: Any) -> Path:
        """Write a checkpoint; see TorchRL.

        Raises:
            OSError: there is not enough space.
        """
        path = Path(path)
        with complete_only(path, replace=True) as scratch:
            super().save(scratch, **options)
            seal(scratch)
        return path

    def load(self, path: str | Path, **options: Any) -> CheckpointLoadResult:
        """Check and load a checkpoint; see TorchRL.

        Raises:
            DamagedFilesError: a file is missing, altered or shorter than written.
            ConfigError: a file is neither safetensors nor JSON, or its content does not fit the
                components.
        """
        check(path)
        try:
            return super().load(path, **options)
        except (CheckpointError, OSError, ValueError, KeyError, TypeError) as error:
            reason = " ".join(str(error).split())
            if "ba_torchrl.state.2" in reason:
                reason = f"{RENAMED}; train again"
            raise ConfigError(
                f"{path} does not fit this version or configuration: {reason}"
            ) from error

    @classmethod
    def manifest(cls, path: str | Path) -> dict[str, Any]:
        """Read the manifest of a checkpoint; see TorchRL.

        Raises:
            CheckpointError: it is none.
        """
        try:
            return super().manifest(path)
        except AttributeError as error:  # TorchRL expects that the file holds a mapping
            raise CheckpointError(f"{path}: the manifest is not a mapping") from error


def saved_steps(folder: Path) -> list[Path]:
    """Return the checkpoints in a folder of TorchRL's `CheckpointRotation`, the newest first.

    Those that cannot be read are included.
    """
    found = (path for path in folder.glob("checkpoint-*") if step_of(path) is not None)
    return sorted(found, key=step_of, reverse=True)


def step_of(path: Path) -> int | None:
    """Return the step of a checkpoint's folder, None if its name has none."""
    step = path.name.removeprefix("checkpoint-")
    return int(step) if step.isdigit() else None


def remove_leftovers(folder: Path) -> None:
    """Delete what an interrupted save left in a folder of checkpoints.

    A checkpoint that was about to be replaced by one of the same step gets its name back.
    """
    for replaced in folder.glob(f".checkpoint-*{OLD}"):
        checkpoint = folder / replaced.name.removeprefix(".").removesuffix(OLD)
        if not checkpoint.exists():
            os.replace(replaced, checkpoint)
    for leftover in folder.glob(".checkpoint-*"):
        if leftover.is_dir():
            shutil.rmtree(leftover)
        else:
            leftover.unlink()


def first_sound(paths: Iterable[Path]) -> Path | None:
    """Return the first of some checkpoints whose files are whole, None if none is.

    A warning names each one that is passed over.
    """
    for path in paths:
        try:
            check(path)
        except DamagedFilesError as error:
            logger.warning("%s: passed over for the one before: %s", path.name, error)
        else:
            return path
    return None


class RunLock(Lock):
    """Locks a run folder until `release` or the end of the process.

    Args:
        folder: of the run, which is created if needed.

    Raises:
        ConfigError: another process holds the lock; the message names it.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        super().__init__(folder / LOCK_FILE, f"runs the experiment in {folder}")


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
