"""Zarr folders, or archives of them, in Diffusion Policy's layout."""

from __future__ import annotations

import json
import math
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError, DamagedFilesError
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
_ZIP_MAGIC = b"PK\x03\x04"
_SHARDING = "sharding_indexed"
_NOT_STORED = np.uint64(2**64 - 1)
"""Offset and length of an inner chunk that its shard does not have."""


class DiffusionPolicy(Format):
    """``data/NAME`` [steps of all episodes, ...], channels last, and ``meta/episode_ends``."""

    channels_last = True
    has_last_observation = False
    package = "zarr"
    tag = "diffusion-policy"

    def matches(self, path: Path) -> bool:
        """Return whether it is a folder or a zip archive with the metadata of a group, or part of
        an archive."""
        if os.path.isfile(path) and not zipfile.is_zipfile(path):
            with path.open("rb") as file:
                return file.read(len(_ZIP_MAGIC)) == _ZIP_MAGIC
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
        if is_zip and not zipfile.is_zipfile(path):
            raise DamagedFilesError(
                f"{path} is a damaged zip archive: it has no end; copy it again"
            )
        store = self.library("zarr.storage").ZipStore(str(path), mode="r") if is_zip else str(path)
        files = zipfile.Path(path) if is_zip else path
        root = zarr.open_group(store, mode="r")
        if fault := _fault(root["meta/episode_ends"], files):
            raise ConfigError(f"{path}: {fault}")
        arrays = list(_arrays(root, files, "data"))
        steps = max((sum(getattr(array, "shape", ())[:1]) for _, array in arrays), default=0)
        try:
            ends = _ends(root["meta/episode_ends"], steps)
        except ConfigError as error:
            raise ConfigError(f"{path}: meta/episode_ends: {error}") from None
        columns = [(name, _column(array, files, ends)) for name, array in arrays]
        episodes: list[dict[str, np.ndarray | Rows]] = [
            {name: column(start, end) for name, column in columns}
            for start, end in zip([0, *ends], ends, strict=False)
        ]
        texts = root["meta"].attrs.get(keys.INSTRUCTION, ())
        if texts and len(texts) != len(episodes):
            raise ConfigError(
                f"{path}: meta has {len(texts)} instructions of {len(episodes)} episodes"
            )
        for episode, text in zip(episodes, texts, strict=False):
            episode[keys.INSTRUCTION] = np.array([text])
        return episodes


def _ends(array: Any, steps: int) -> list[int]:
    """Return the ends of the episodes.

    Args:
        steps: most rows that an array of the data has.

    Raises:
        ConfigError: they are no whole numbers that rise, or more than there are steps.
    """
    if len(array.shape) != 1 or array.dtype.kind not in "iuf":
        raise ConfigError(f"needed one whole number per episode, found {array.dtype} {array.shape}")
    if array.shape[0] > steps:
        raise ConfigError(f"{array.shape[0]} episodes end, but data has {steps} steps")
    found = array[:]
    if not (is_whole := np.isfinite(found) & (found == np.floor(found))).all():
        raise ConfigError(f"the end {found[~is_whole][0]:g} is no whole number of steps")
    ends = found.astype(np.int64)
    if (np.diff(ends, prepend=0) <= 0).any():
        raise ConfigError("the ends do not rise: an episode has no steps")
    return ends.tolist()


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
    owner = getattr(array, "metadata", array)  # zarr 3 warns of the array's own attribute
    names = f"{owner.compressor} {owner.filters}" if _is_v2(array) else ""
    is_object = array.dtype.hasobject and array.dtype.kind != "T"  # which is text
    if is_object or "pickle" in names.lower():
        return f"the array {array.path} is not opened: objects could run code"
    try:
        missing = _missing(array, files)
    except ConfigError as error:
        return f"{array.path}: {error}"
    if not missing:
        return ""
    setting = "zarr.config.set({'array.write_empty_chunks': True}); "
    return (
        f"{missing} of {array.path} is missing; zarr reads it as {array.fill_value}. Copy the file "
        "again. If its writer left it out on purpose, as zarr 3 does with zeros, write it: "
        f"{'' if _is_of_zarr_2(array) else setting}"
        f"array = zarr.open_group(FOLDER, mode='r+')['{array.path}']; array[:] = array[:]"
    )


def _missing(array: Any, files: Any) -> str:
    """Return the first chunk that is not stored, in words; empty if all are.

    The time it takes grows with the number of stored chunks, not with the length in the header.
    """
    if not array.shape:
        return ""
    sizes = getattr(array, "shards", None) or array.chunks
    grid = [-(-length // size) for length, size in zip(array.shape, sizes, strict=True)]
    codecs = () if _is_v2(array) else array.metadata.to_dict()["codecs"]
    is_sharded = _SHARDING in json.dumps(codecs)
    for number in range(math.prod(grid)):
        index, rest = [0] * len(grid), number
        for axis in reversed(range(len(grid))):
            rest, index[axis] = divmod(rest, grid[axis])
        chunk = _chunk(array, tuple(index))
        if not (files / chunk).is_file():
            return f"the chunk {chunk}, number {number + 1} of {math.prod(grid)},"
        if not is_sharded:
            continue
        lengths = [
            min(size, length - at * size)
            for length, at, size in zip(array.shape, index, sizes, strict=True)
        ]
        try:
            inner = _missing_in_shard(files / chunk, codecs, sizes, lengths)
        except ConfigError:
            raise
        except (OSError, ValueError, LookupError) as error:
            raise ConfigError(f"the shard {chunk} is damaged: {error}") from None
        if inner:
            return f"{inner} of the shard {chunk}"
    return ""


def _missing_in_shard(
    shard: Any, codecs: Sequence[Any], sizes: Sequence[int], lengths: Sequence[int]
) -> str:
    """Return the first inner chunk that the index of a shard does not have, in words.

    Args:
        shard: its file.
        codecs: of the array, as in its metadata.
        sizes: of a whole shard.
        lengths: of the part of the shard that is within the array.
    """
    inside = codecs[0].get("configuration", {})
    kinds = [codec["name"] for codec in inside.get("index_codecs", ())]
    is_known = len(codecs) == 1 and kinds in (["bytes"], ["bytes", "crc32c"])
    if not is_known or _SHARDING in json.dumps(inside):
        raise ConfigError(
            "the codecs of its shards do not show whether all chunks are there; write the array "
            "again without shards"
        )
    endian = inside["index_codecs"][0].get("configuration", {}).get("endian", "little")
    counts = [size // side for size, side in zip(sizes, inside["chunk_shape"], strict=True)]
    length, checksum = 16 * math.prod(counts), 4 * (len(kinds) - 1)
    with shard.open("rb") as file:
        if inside.get("index_location", "end") == "end":
            file.seek(-length - checksum, os.SEEK_END)
        table = np.frombuffer(file.read(length), ">u8" if endian == "big" else "<u8")
    table = table.reshape(*counts, 2)
    for axis, (rows, side) in enumerate(zip(lengths, inside["chunk_shape"], strict=True)):
        table = np.take(table, range(-(-rows // side)), axis)
    is_missing = (table == _NOT_STORED).all(-1)
    if not is_missing.any():
        return ""
    first = ", ".join(map(str, np.argwhere(is_missing)[0].tolist()))
    return f"the inner chunk ({first}), the first of {is_missing.sum()},"


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
