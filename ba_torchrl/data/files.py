"""Folders of data: tensors in safetensors files and values in JSON, with checksums.

`seal` writes ``checksums.json``, with length and CRC-32 of every file of a folder; `check` compares
the folder with it. No file of another type is opened, so that none can run code.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ba_torchrl.errors import ConfigError, DamagedFilesError

OLD = ".old"
"""Suffix of a folder that `publish` replaces."""
CHECKSUMS_FILE = "checksums.json"
_DATA_SUFFIXES = frozenset({".json", ".safetensors"})
_TENSORS_FILE, _VALUES_FILE = "tensors.safetensors", "values.json"
_CHUNK = 1 << 20


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
        ConfigError: a file is neither safetensors nor JSON.
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


@contextmanager
def complete_only(path: Path) -> Iterator[Path]:
    """Yield a path of the same name in a hidden folder, for a file or folder that is written there.

    When it is complete on the disk, it gets its place, after the files beside it. If the block
    raises, nothing of it remains.

    Args:
        path: of a new file or folder.
    """
    scratch = path.with_name(f".{path.name}.scratch")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    try:
        yield scratch / path.name
        for part in scratch.rglob("*"):
            _flush(part)
        for part in sorted(scratch.iterdir(), key=lambda part: part.name == path.name):
            os.replace(part, path.with_name(part.name))
        _flush(path.parent)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def check(folder: str | Path) -> None:
    """Check that a folder holds the files that `seal` found in it, unaltered.

    Raises:
        DamagedFilesError: a file is missing, shorter, altered or not listed; or there are no
            checksums.
        ConfigError: a file is neither safetensors nor JSON.
    """
    folder = Path(folder)
    try:
        listed = json.loads((folder / CHECKSUMS_FILE).read_text(encoding="utf-8"))["crc32"]
        listed = {name: (int(size), int(checksum)) for name, (size, checksum) in listed.items()}
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


def write_state(folder: str | Path, state: Mapping[str, Any]) -> None:
    """Write a nested state of tensors and plain values into a folder, without checksums.

    Args:
        folder: created if needed.
        state: as ``state_dict`` returns.

    Raises:
        OSError: there is not enough space, or a file cannot be written.
        TypeError: a value is neither a tensor, an array nor plain.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    tensors: dict[str, torch.Tensor] = {}
    values = _encoded(state, tensors)
    (folder / _VALUES_FILE).write_text(json.dumps(values) + "\n", encoding="utf-8")
    try:
        save_file(tensors, folder / _TENSORS_FILE)
    except SafetensorError as error:
        number = re.search(r"os error (\d+)", str(error))
        code = int(number[1]) if number else errno.EIO
        raise OSError(code, os.strerror(code), str(folder / _TENSORS_FILE)) from error


def read_state(folder: str | Path) -> dict[str, Any]:
    """Return a state that `write_state` wrote, with its tensors on the CPU.

    Raises:
        DamagedFilesError: the files are not a state.
    """
    folder = Path(folder)
    try:
        values = json.loads((folder / _VALUES_FILE).read_text(encoding="utf-8"))
        with safe_open(folder / _TENSORS_FILE, framework="pt") as file:
            # copies, as the file may be deleted or altered while they are in use
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
        return dict(_decoded(values, tensors))
    except (OSError, ValueError, LookupError, TypeError, SafetensorError, RecursionError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise DamagedFilesError(
            f"{folder} does not hold a state: {type(error).__name__}: {reason}"
        ) from error


def _encoded(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """Return a state as JSON values, and collect its tensors under the names that it has there."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list):
        return [_encoded(item, tensors) for item in value]
    if isinstance(value, tuple):
        return {"tuple": [_encoded(item, tensors) for item in value]}
    if isinstance(value, Mapping):
        pairs = value.items()
        return {"dict": [[_encoded(key, tensors), _encoded(item, tensors)] for key, item in pairs]}
    if not isinstance(value, torch.Tensor | np.ndarray):
        raise TypeError(f"a state holds tensors and plain values, not {type(value).__name__}")
    kind, name = "array" if isinstance(value, np.ndarray) else "tensor", str(len(tensors))
    # a copy, since safetensors refuses tensors that share memory
    tensors[name] = torch.as_tensor(value).detach().to("cpu", copy=True).contiguous()
    return {kind: name}


def _decoded(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """Return the state of which `_encoded` returned the values."""
    if isinstance(value, list):
        return [_decoded(item, tensors) for item in value]
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "tuple":
        return tuple(_decoded(item, tensors) for item in content)
    if kind == "dict":
        return {_decoded(key, tensors): _decoded(item, tensors) for key, item in content}
    if kind not in ("tensor", "array"):
        raise ValueError(f"unknown kind of value {kind!r}")
    return tensors[content] if kind == "tensor" else tensors[content].numpy()


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
            DamagedFilesError: the files are not a state.
        """
        self.load_state_dict(read_state(path))


def _files(folder: Path) -> Iterator[Path]:
    """Yield the files below a folder.

    Raises:
        ConfigError: one of them is not plain data.
    """
    for path in sorted(folder.rglob("*")):
        if path.is_symlink() or not (path.is_dir() or path.suffix in _DATA_SUFFIXES):
            raise ConfigError(
                f"{path} is not opened: only {' and '.join(sorted(_DATA_SUFFIXES))} files are "
                "data, others could run code. Folders of earlier versions are not read"
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
