"""Zarr folders, or archives of them, in Diffusion Policy's layout."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.demonstrations.formats.base import (
    FORMATS,
    Arrays,
    Card,
    Entry,
    Format,
    Rows,
    StoredArrays,
)

_CHUNK_STEPS = 64


class DiffusionPolicy(Format):
    """``data/NAME`` [steps of all episodes, ...], channels last, and ``meta/episode_ends``."""

    channels_last = True
    has_last_observation = False
    package = "zarr"
    tag = "diffusion-policy"

    def matches(self, path: Path) -> bool:
        """Return whether it is a folder or a zip archive with the metadata of a group."""
        return any(_has_file(path, name) for name in (".zgroup", "zarr.json"))

    def names(self, entries: Mapping[str, Entry]) -> dict[str, str]:
        """Return the keys unchanged: the format leaves names to the user's ``shape_meta``."""
        return {key: key for key in entries}

    def write(self, path: Path, episodes: Sequence[Arrays], card: Card) -> None:
        """Write version 2 of the format, which Diffusion Policy reads, with its compression."""
        zarr = self.library("zarr")
        version = {"zarr_format": 2} if _major(zarr) >= 3 else {}
        root = zarr.open_group(str(path), mode="w", **version)
        data, meta = root.create_group("data"), root.create_group("meta")
        for name in episodes[0].keys() - {keys.INSTRUCTION}:
            parts = [arrays[name] for arrays in episodes]
            has_last = card.entries[name].role == "observation"
            rows = np.concatenate([part[:-1] if has_last else part for part in parts])
            _store(data, name, rows)
        lengths = [len(arrays["action"]) for arrays in episodes]
        _store(meta, "episode_ends", np.cumsum(lengths, dtype=np.int64))
        if keys.INSTRUCTION in episodes[0]:
            meta.attrs[keys.INSTRUCTION] = [str(arrays[keys.INSTRUCTION][0]) for arrays in episodes]

    def read(self, path: Path) -> list[StoredArrays]:
        """Return every array below ``data``, cut at the ends of the episodes."""
        zarr, is_zip = self.library("zarr"), path.is_file()
        store = self.library("zarr.storage").ZipStore(str(path), mode="r") if is_zip else str(path)
        files = zipfile.Path(path) if is_zip else path
        root = zarr.open_group(store, mode="r")
        if fault := _fault(root["meta/episode_ends"], files):
            raise ConfigError(f"{path}: {fault}")
        ends = [int(end) for end in root["meta/episode_ends"][:]]
        if [0, *ends] != sorted({0, *ends}):
            raise ConfigError(f"{path}: meta/episode_ends do not rise: an episode has no steps")
        columns = [
            (name, _column(array, files, ends)) for name, array in _arrays(root, files, "data")
        ]
        episodes: list[dict[str, np.ndarray | Rows]] = [
            {name: column(start, end) for name, column in columns}
            for start, end in zip([0, *ends], ends, strict=False)
        ]
        texts = root["meta"].attrs.get(keys.INSTRUCTION, ())
        for episode, text in zip(episodes, texts, strict=False):
            episode[keys.INSTRUCTION] = np.array([text])
        return episodes


def _store(group: Any, name: str, values: np.ndarray) -> None:
    """Write an array with all of its chunks, also those of zeros."""
    steps = _CHUNK_STEPS if values.ndim > 2 else max(len(values), 1)
    options = {"shape": values.shape, "dtype": values.dtype, "chunks": (steps, *values.shape[1:])}
    whole = {"write_empty_chunks": True}
    if hasattr(group, "create_array"):  # zarr 3
        array = group.create_array(name, **options, config=whole)
    else:
        array = group.create_dataset(name, **options, **whole)
    array[:] = values


def _has_file(path: Path, name: str) -> bool:
    """Return whether a folder or a zip archive has a file."""
    if not zipfile.is_zipfile(path):
        return os.path.isfile(path / name)
    with zipfile.ZipFile(path) as archive:
        return name in archive.namelist()


def _arrays(root: Any, files: Any, place: str) -> Iterator[tuple[str, Any]]:
    """Yield the arrays below a group, by their paths from there; those unknown as an exception.

    Args:
        files: path of the folder, or of the root of the archive.
    """
    for name in sorted(file.name for file in (files / place).iterdir() if file.is_dir()):
        try:
            item = root[f"{place}/{name}"]
        except KeyError:  # a folder of something else
            continue
        except (TypeError, ValueError) as error:  # an unknown type or codec
            yield name, error
            continue
        if hasattr(item, "shape"):
            yield name, item
        else:
            for below, array in _arrays(root, files, f"{place}/{name}"):
                yield f"{name}/{below}", array


def _column(array: Any, files: Any, ends: list[int]) -> Callable[[int, int], Rows]:
    """Return a function from first step and end to rows of an array, all of which are read once."""
    if isinstance(array, Exception):
        return lambda start, end: Rows((end - start,), np.dtype(float), list, str(array))
    fault = _fault(array, files)
    if not fault and array.shape[:1] != (ends[-1] if ends else 0,):
        fault = f"{array.path} has the shape {list(array.shape)}, the episodes end at {ends[-1:]}"
    read = cache(lambda: array[:])
    return lambda start, end: Rows(
        (end - start, *array.shape[1:]), array.dtype, lambda: read()[start:end], fault
    )


def _fault(array: Any, files: Any) -> str:
    """Return why an array cannot be used: decoding could run code, or chunks are missing.

    zarr decodes pickles, and reads a missing chunk as the array's fill value. Whether its writer
    left the chunk out because it had that value only, as zarr 3 does, is not in the file.
    """
    names = str(getattr(array, "compressor", None)) + str(array.filters) if _is_v2(array) else ""
    is_object = array.dtype.hasobject and array.dtype.kind != "T"  # which is text
    if is_object or "pickle" in names.lower():
        return f"the array {array.path} is not opened: objects could run code"
    sizes = getattr(array, "shards", None) or array.chunks
    grid = (range(-(-length // size)) for length, size in zip(array.shape, sizes, strict=True))
    chunks = [_chunk(array, index) for index in product(*grid)] if array.shape else []
    missing = [chunk for chunk in chunks if not (files / chunk).exists()]
    if not missing:
        return ""
    setting = "zarr.config.set({'array.write_empty_chunks': True}); "
    return (
        f"{len(missing)} of {len(chunks)} chunks of {array.path} are missing, the first "
        f"{missing[0]}; zarr reads them as {array.fill_value}. Copy the file again. If its writer "
        "left them out on purpose, as zarr 3 does with zeros, write them: "
        f"{'' if _is_of_zarr_2(array) else setting}"
        f"array = zarr.open_group(FOLDER, mode='r+')['{array.path}']; array[:] = array[:]"
    )


def _chunk(array: Any, index: tuple[int, ...]) -> str:
    """Return the path of a chunk, or of a shard of chunks."""
    if _is_of_zarr_2(array):
        return array._chunk_key(index)
    return f"{array.path}/{array.metadata.encode_chunk_key(index)}"


def _is_of_zarr_2(array: object) -> bool:
    """Whether version 2 of the library, which writes all chunks, has opened the array."""
    return hasattr(array, "_chunk_key")


def _is_v2(array: object) -> bool:
    """Whether the array has version 2 of the format; version 3 has no codec of objects."""
    return getattr(getattr(array, "metadata", None), "zarr_format", 2) == 2


def _major(zarr: object) -> int:
    return int(zarr.__version__.split(".")[0])


FORMATS.register("zarr")(DiffusionPolicy())
