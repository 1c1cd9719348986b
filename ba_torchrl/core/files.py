"""Folders of data: tensors in safetensors files and values in JSON, with checksums.

`write_checksums` writes ``checksums.json``, with length and CRC-32 of every file of a folder;
`verify_checksums` compares the folder with it. No file of another type is opened, so that none can
run code. Hidden files and texts are ignored, and links to files are followed.

`atomic_file` and `atomic_output` give a file or folder its name when it is complete on the disk.
`Lock` keeps other processes out, and `lock_holder` names the one inside (POSIX systems).
"""

from __future__ import annotations

import errno
import fcntl
import functools
import json
import logging
import os
import re
import shutil
import socket
import time
import zlib
from codecs import BOM_UTF8
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors import SafetensorError, deserialize, safe_open

from ba_torchrl.core.errors import ConfigError, DamagedFilesError

if TYPE_CHECKING:
    import torch

OLD = ".old"
"""Suffix of a folder that `atomic_output` replaces."""
CHECKSUMS_FILE = "checksums.json"
RENAMED = "the image with the key pixels is now depth in close loop, heightmap in open loop"
"""Why files of another format are refused."""
_DATA_SUFFIXES = frozenset({".json", ".safetensors"})
_TEXT_SUFFIXES = frozenset({".md", ".txt"})
_TENSORS_FILE, _VALUES_FILE = "tensors.safetensors", "values.json"
_CHUNK = 1 << 20
_SETTLED_S = 2.0
"""Age of a file's last change from which another change has another time in the file system."""
_SCRATCH = re.compile(r"\.\d+\.[0-9a-f]{6}\.")
"""Begin of the names that `atomic_file` yields."""
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}
"""Of file systems of networks that are mounted without locks."""
_UNNAMED = "another process"
_ASKING_S = 0.05
"""Time in which `lock_holder` has let go of a lock."""

logger = logging.getLogger(__name__)


def write_text(path: str | Path, text: str) -> Path:
    """Write a text file, which appears under its name when it is complete on the disk.

    Args:
        path: of the file; an existing one is replaced.
        text: its content.
    """
    path = Path(path)
    with errors_naming(path), atomic_file(path) as scratch:
        scratch.write_text(text, encoding="utf-8")
    return path


@contextmanager
def errors_naming(path: Path) -> Iterator[None]:
    """Context whose errors of the system name a path, if they name none, as on a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """Yield a path with the same suffix, for a file that takes a name when it is complete.

    If the block raises, an older file of that name remains. A device is written to directly.

    Args:
        path: of the file, or a link to it; its folder is created if needed.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        yield path
        return
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{os.getpid()}.{os.urandom(3).hex()}.{path.name}")
    try:
        yield scratch
        _flush(scratch)
        os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)
    _flush(path.parent)


def remove_scratch(folder: Path) -> None:
    """Delete what a killed process left of files in a folder that no other process writes to."""
    for path in folder.glob(".[0-9]*.*"):
        if _SCRATCH.match(path.name):
            path.unlink()


def write_checksums(folder: str | Path) -> None:
    """Write the checksums of a folder's files, and wait until all of them are on the disk.

    Raises:
        ConfigError: a file is neither safetensors nor JSON.
    """
    folder = Path(folder)
    (folder / CHECKSUMS_FILE).unlink(missing_ok=True)
    files = {path.relative_to(folder).as_posix(): size_and_crc32(path) for path in _files(folder)}
    write_text(folder / CHECKSUMS_FILE, json.dumps({"crc32": files}, indent=1) + "\n")
    for path in [folder, *folder.rglob("*")]:
        _flush(path)


@contextmanager
def atomic_output(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yield a path of the same name in a hidden folder, for a file or folder that is written there.

    When it is complete on the disk, it gets its place, after the files beside it. If the block
    raises, nothing of it remains. One process at a time is in the block.

    Args:
        path: of a file or folder, which is new unless ``replace``.
        replace: delete an older one of that name afterwards.

    Raises:
        ConfigError: another process writes it, or it exists.
    """
    path = path.resolve() if path.is_dir() else path  # an empty one may be a link
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = Lock(path.with_name(f".{path.name}.lock"), f"writes {path}; choose another path")
    scratch, old = (path.with_name(f".{path.name}{end}") for end in (".scratch", OLD))
    try:
        is_empty = path.is_dir() and not any(path.iterdir())
        if os.path.lexists(path) and not replace and not is_empty:
            raise ConfigError(f"{path} exists already; choose another path")
        shutil.rmtree(scratch, ignore_errors=True)  # of a process that was killed
        scratch.mkdir()
        yield scratch / path.name
        for part in scratch.rglob("*"):
            _flush(part)
        for part in sorted(scratch.iterdir(), key=lambda part: part.name == path.name):
            target = path.with_name(part.name)
            if target.is_dir():
                shutil.rmtree(old, ignore_errors=True)
                os.replace(target, old)
            os.replace(part, target)
        _flush(path.parent)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        lock.release()


class Lock:
    """Locks a file, which is created, until `release` or the end of the process.

    Args:
        path: of the file, which names the process.
        what: the process does, in words.

    Raises:
        ConfigError: another process holds the lock; the message names it.
    """

    def __init__(self, path: Path, what: str) -> None:
        self._path = path
        waits = [_ASKING_S] * 3
        while True:
            self._file = path.open("a+")
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.path.samestat(os.fstat(self._file.fileno()), path.stat()):
                    break
            except FileNotFoundError:  # its holder has deleted it
                pass
            except BlockingIOError:
                if not waits:
                    self._file.seek(0)
                    holder = self._file.read() or _UNNAMED
                    self._file.close()
                    raise ConfigError(f"{holder} {what}") from None
                time.sleep(waits.pop())
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    self.release()
                    raise
                logger.warning("%s: this file system has no locks, others are not kept out", path)
                break
            self._file.close()
        try:
            with errors_naming(path):
                self._file.truncate(0)
                name = f"process {os.getpid()} on {socket.gethostname()}"
                os.write(self._file.fileno(), name.encode())
        except OSError:
            self.release()
            raise

    def release(self) -> None:
        """Unlock and delete the file; further calls have no effect."""
        if not self._file.closed:
            self._path.unlink(missing_ok=True)
            self._file.close()


def lock_holder(path: Path) -> str | None:
    """Return the process that holds the lock of a file, such as "process 12 on a-host".

    None if there is none, or if the file system has no locks.
    """
    try:
        with path.open() as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return file.read() or _UNNAMED
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
    except FileNotFoundError:
        pass
    return None


def verify_checksums(folder: str | Path) -> None:
    """Check that a folder holds the files that `write_checksums` found in it, unaltered.

    Raises:
        DamagedFilesError: a file is missing, shorter, altered or not listed; or there are no
            checksums.
        ConfigError: a file is neither safetensors nor JSON.
    """
    folder = Path(folder)
    try:
        listed = read_json(folder / CHECKSUMS_FILE)["crc32"]
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
        size, checksum = size_and_crc32(path)
        if size != listed[name][0]:
            raise DamagedFilesError(f"{path} has {size} bytes, {listed[name][0]} were written")
        if (size, checksum) != listed[name]:
            raise DamagedFilesError(f"{path} was altered: its checksum differs")


def write_state(folder: str | Path, state: Mapping[str, Any]) -> None:
    """Write a nested state of tensors and plain values into a folder, without checksums.

    Raises:
        OSError: there is not enough space, or a file cannot be written.
        TypeError: a value is neither a tensor, an array nor plain.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    tensors: dict[str, torch.Tensor] = {}
    values = _encoded(state, tensors)
    with errors_naming(folder):
        (folder / _VALUES_FILE).write_text(json.dumps(values) + "\n", encoding="utf-8")
    write_tensors(folder / _TENSORS_FILE, tensors)


def write_tensors(path: Path, tensors: dict[str, torch.Tensor]) -> None:
    """Write a safetensors file."""
    from safetensors.torch import save_file

    try:
        save_file(tensors, path)
    except SafetensorError as error:
        number = re.search(r"os error (\d+)", str(error))
        code = int(number[1]) if number else errno.EIO
        raise OSError(code, os.strerror(code), str(path)) from error


def header_texts(path: Path, content: bytes | None = None) -> dict[str, str]:
    """Return the texts in the header of a safetensors file, by name; no tensor is read.

    Args:
        path: of the file.
        content: of the file, if it has been read: another process may have replaced the file.

    Raises:
        DamagedFilesError: it is not such a file, its header is longer than 100 MB, or the file has
            another length than the header says.
    """
    try:
        if content is None:
            with safe_open(path, framework="np") as file:
                return file.metadata() or {}
        deserialize(content)  # checks header and length
        header = content[8 : 8 + int.from_bytes(content[:8], "little")]
        return json.loads(header).get("__metadata__") or {}
    except SafetensorError as error:
        raise DamagedFilesError(f"{path} is not a whole safetensors file: {error}") from None


def json_bytes(path: str | Path) -> bytes:
    """Return the text of a JSON file, without the byte-order mark that editors may add."""
    return Path(path).read_bytes().removeprefix(BOM_UTF8)


def read_json(path: str | Path) -> Any:
    """Return the content of a JSON file; `ValueError` if it is not JSON."""
    return json.loads(json_bytes(path))


def read_state(folder: str | Path) -> dict[str, Any]:
    """Return a state that `write_state` wrote, with its tensors on the CPU.

    Raises:
        DamagedFilesError: the files are not a state.
    """
    folder = Path(folder)
    try:
        values = read_json(folder / _VALUES_FILE)
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
    import torch  # here: commands write texts without it

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
        """Write the state into a folder; see `write_state`."""
        write_state(path, self.state_dict())

    def loads(self, path: str | Path) -> None:
        """Read a folder that ``dumps`` wrote; see `read_state`."""
        self.load_state_dict(read_state(path))


def _files(folder: Path) -> Iterator[Path]:
    """Yield the files of data below a folder, without hidden files and texts; `ConfigError` if one
    of them is not plain data."""
    for path in sorted(folder.rglob("*")):
        is_hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if is_hidden or path.suffix in _TEXT_SUFFIXES:
            continue
        is_folder = path.is_dir() and not path.is_symlink()
        if not is_folder and not (path.is_file() and path.suffix in _DATA_SUFFIXES):
            raise ConfigError(
                f"{path} is not opened: only {' and '.join(sorted(_DATA_SUFFIXES))} files are "
                "data, others could run code. Folders of earlier versions are not read"
            )
        if path.is_file():
            yield path


def size_and_crc32(path: Path) -> tuple[int, int]:
    """Return length and CRC-32 of a file; they are computed once while it is unchanged."""
    found = path.stat()
    if time.time() - found.st_ctime < _SETTLED_S:
        return _size_and_crc32.__wrapped__(path, ())
    state = (found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)
    return _size_and_crc32(path.absolute(), state)


@functools.lru_cache(maxsize=4096)
def _size_and_crc32(path: Path, state: tuple[int, ...]) -> tuple[int, int]:
    """Read a file for `size_and_crc32`; ``state`` changes with its content."""
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
