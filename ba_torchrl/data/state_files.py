"""Folders of data: tensors as memory maps and values as JSON, with checksums, read without pickle.

`seal` writes ``checksums.json``, with length and CRC-32 of every file of a folder; `check` compares
the folder with it. Both refuse files of other types, so that TorchRL's and TensorDict's readers,
which unpickle some of them, find none.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.checkpoint import StateDictCheckpointAdapter

from ba_torchrl.errors import ConfigError, DamagedFilesError, as_os_error

OLD = ".old"
"""Suffix of a folder that `publish` replaces."""
CHECKSUMS_FILE = "checksums.json"
_DATA_SUFFIXES = frozenset({".json", ".memmap"})
_CHUNK = 1 << 20
_LOAD_ERRORS = (
    ArithmeticError,
    AttributeError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What the readers of JSON, tensors and TensorDicts raise for files of another content."""
_RESERVE = 10_000_000
"""Bytes for all files besides the tensors, and for tensors that take whole blocks."""


def write_text(path: str | Path, text: str) -> Path:
    """Write a text file, which appears under its name when it is complete on the disk.

    Args:
        path: of the file; an existing one is replaced.
        text: its content.
    """
    path = Path(path)
    scratch = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with scratch.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)
    _flush(path.parent)
    return path


def seal(folder: str | Path) -> None:
    """Write the checksums of a folder's files, and wait until all of them are on the disk.

    Raises:
        ConfigError: a file is neither a memory map nor JSON.
    """
    folder = Path(folder)
    (folder / CHECKSUMS_FILE).unlink(missing_ok=True)
    files = {path.relative_to(folder).as_posix(): _fingerprint(path) for path in _files(folder)}
    write_text(folder / CHECKSUMS_FILE, json.dumps({"crc32": files}, indent=1) + "\n")
    for path in [folder, *folder.rglob("*")]:
        _flush(path)


def publish(scratch: Path, folder: Path) -> None:
    """Give a sealed folder its final name; a folder of that name is deleted afterwards."""
    old = folder.with_name(f".{folder.name}{OLD}")
    shutil.rmtree(old, ignore_errors=True)
    if folder.exists():
        os.replace(folder, old)
    os.replace(scratch, folder)
    _flush(folder.parent)
    shutil.rmtree(old, ignore_errors=True)


def check(folder: str | Path) -> None:
    """Check that a folder holds the files that `seal` found in it, unaltered.

    Raises:
        DamagedFilesError: a file is missing, shorter, altered or not listed; or there are no
            checksums.
        ConfigError: a file is neither a memory map nor JSON.
    """
    folder = Path(folder)
    try:
        listed = json.loads((folder / CHECKSUMS_FILE).read_text(encoding="utf-8"))["crc32"]
        listed = {name: tuple(fingerprint) for name, fingerprint in listed.items()}
    except FileNotFoundError:
        raise DamagedFilesError(
            f"{folder} has no {CHECKSUMS_FILE}: it is incomplete, or of an earlier version"
        ) from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DamagedFilesError(f"{folder / CHECKSUMS_FILE} is damaged: {error}") from None
    found = {path.relative_to(folder).as_posix(): path for path in _files(folder)}
    found.pop(CHECKSUMS_FILE)
    for name in sorted(found.keys() ^ listed.keys()):
        reason = "is missing" if name in listed else f"is not listed in {CHECKSUMS_FILE}"
        raise DamagedFilesError(f"{folder / name} {reason}")
    for name, path in found.items():
        size, checksum = _fingerprint(path)
        if size != listed[name][0]:
            raise DamagedFilesError(f"{path} has {size} bytes, {listed[name][0]} were written")
        if (size, checksum) != listed[name]:
            raise DamagedFilesError(f"{path} was altered: its checksum differs")


def write_state(folder: str | Path, state: dict[str, Any]) -> None:
    """Write a nested state of tensors and plain values into a folder, without checksums.

    Args:
        folder: created if needed.
        state: as ``state_dict`` returns.

    Raises:
        OSError: there is not enough space, or a file cannot be written.
    """
    check_space(folder, state)
    try:
        _ADAPTER.save(_State(state), Path(folder), args=(), kwargs={})
    except RuntimeError as error:
        raise as_os_error(error) or error from None


def read_state(folder: str | Path) -> dict[str, Any]:
    """Return a state that `write_state` wrote, with its tensors on the CPU.

    Raises:
        ConfigError: a file is neither a memory map nor JSON.
        DamagedFilesError: the files are not a state.
    """
    folder = Path(folder)
    for _ in _files(folder):  # refuses what TensorDict would unpickle
        pass
    holder = _State({})
    try:
        _ADAPTER.load(holder, folder, map_location="cpu", tensor_load_kwargs={}, args=(), kwargs={})
    except _LOAD_ERRORS as error:
        raise _not_a_state(folder, error) from error
    return holder.state


class StateFolder:
    """A class with a state that is written into a folder, as plain data.

    Precedes TorchRL's class among the bases, whose ``loads`` could unpickle.
    """

    def dumps(self, path: str | Path) -> None:
        """Write the state into a folder.

        Raises:
            OSError: there is not enough space, or a file cannot be written.
        """
        write_state(path, self.state_dict())

    def loads(self, path: str | Path) -> None:
        """Read a folder that ``dumps`` wrote.

        Raises:
            ConfigError: a file is neither a memory map nor JSON.
            DamagedFilesError: the files are not a state.
        """
        self.load_state_dict(read_state(path))


def _not_a_state(folder: Path, error: Exception) -> DamagedFilesError:
    reason = (str(error).splitlines() or [""])[0]
    return DamagedFilesError(f"{folder} does not hold a state: {type(error).__name__}: {reason}")


def check_space(folder: str | Path, state: Any) -> None:
    """Check that the tensors of a state fit on the disk.

    Writing a memory map to a full disk would end the process (SIGBUS).

    Args:
        folder: which need not exist.
        state: nested dictionaries and sequences with tensors.

    Raises:
        OSError: there is not enough space.
    """
    existing = next(path for path in (Path(folder), *Path(folder).parents) if path.exists())
    needed, free = _bytes(state) + _RESERVE, shutil.disk_usage(existing).free
    if needed > free:
        raise OSError(
            errno.ENOSPC,
            f"{needed / 1e6:.0f} MB are needed, {free / 1e6:.0f} MB are free",
            str(existing),
        )


def _bytes(state: Any) -> int:
    if isinstance(state, torch.Tensor | np.ndarray):
        return state.nbytes
    if isinstance(state, Mapping):
        return sum(map(_bytes, state.values()))
    return sum(map(_bytes, state)) if isinstance(state, list | tuple) else 0


class _State:
    """The interface that TorchRL's adapter saves and loads."""

    def __init__(self, state: dict[str, Any]) -> None:
        self.state = state

    def state_dict(self) -> dict[str, Any]:
        return self.state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.state = state


_ADAPTER = StateDictCheckpointAdapter("directory")


def _files(folder: Path) -> Iterator[Path]:
    """Yield the files below a folder.

    Raises:
        ConfigError: one of them is not plain data.
    """
    for path in sorted(folder.rglob("*")):
        if path.is_symlink() or not (path.is_dir() or path.suffix in _DATA_SUFFIXES):
            raise ConfigError(
                f"{path} is not opened: only {' and '.join(sorted(_DATA_SUFFIXES))} files are "
                "data, others could run code"
            )
        if path.is_file():
            yield path


def _fingerprint(path: Path) -> tuple[int, int]:
    """Return length and CRC-32 of a file."""
    size = checksum = 0
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            size += len(chunk)
            checksum = zlib.crc32(chunk, checksum)
    return size, checksum


def _flush(path: Path) -> None:
    """Wait until a file, or the entries of a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
