"""Zarr folders in Diffusion Policy's layout."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ba_torchrl.data.formats.base import FORMATS, Arrays, Card, Entry, Format
from ba_torchrl.envs import keys
from ba_torchrl.errors import ConfigError

_CHUNK_STEPS = 64


class DiffusionPolicy(Format):
    """``data/NAME`` [steps of all episodes, ...], channels last, and ``meta/episode_ends``."""

    channels_last = True
    has_last_observation = False
    package = "zarr"

    def matches(self, path: Path) -> bool:
        """Return whether it is a folder with the metadata of a group."""
        return any(os.path.isfile(path / name) for name in (".zgroup", "zarr.json"))

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
            _store(data, name, np.concatenate([part[:-1] if has_last else part for part in parts]))
        lengths = [len(arrays["action"]) for arrays in episodes]
        _store(meta, "episode_ends", np.cumsum(lengths, dtype=np.int64))
        if keys.INSTRUCTION in episodes[0]:
            meta.attrs[keys.INSTRUCTION] = [str(arrays[keys.INSTRUCTION][0]) for arrays in episodes]

    def read(self, path: Path) -> list[Arrays]:
        """Read every array of ``data``, cut at the ends of the episodes."""
        zarr = self.library("zarr")
        root = zarr.open_group(str(path), mode="r")
        data, meta = root["data"], root["meta"]
        for array in (*(data[name] for name in data), meta["episode_ends"]):
            _check_plain(array)
        ends = [int(end) for end in meta["episode_ends"][:]]
        steps = {name: data[name][:] for name in data}
        if ends != sorted(set(ends)):
            raise ConfigError(f"{path}: meta/episode_ends do not rise: an episode has no steps")
        for name, rows in steps.items():
            if ends[-1:] != [len(rows)]:
                raise ConfigError(f"{path}: {name} has {len(rows)} rows, the episodes {ends[-1:]}")
        episodes = [
            {name: values[start:end] for name, values in steps.items()}
            for start, end in zip([0, *ends], ends, strict=False)
        ]
        for arrays, text in zip(episodes, meta.attrs.get(keys.INSTRUCTION, ()), strict=False):
            arrays[keys.INSTRUCTION] = np.array([text])
        return episodes


def _store(group: object, name: str, values: np.ndarray) -> None:
    steps = _CHUNK_STEPS if values.ndim > 2 else max(len(values), 1)
    chunks = (steps, *values.shape[1:])
    array = group.create_dataset(name, shape=values.shape, dtype=values.dtype, chunks=chunks)
    array[:] = values


def _check_plain(array: object) -> None:
    """Refuse an array whose decoding could run code: zarr decodes pickles.

    Raises:
        ConfigError: its type is no plain one, or its codec is a pickle.
    """
    names = str(getattr(array, "compressor", None)) + str(array.filters) if _is_v2(array) else ""
    if array.dtype.hasobject or "pickle" in names.lower():
        raise ConfigError(f"the array {array.name} is not opened: objects could run code")


def _is_v2(array: object) -> bool:
    """Whether the array has version 2 of the format; version 3 has no codec of objects."""
    return getattr(getattr(array, "metadata", None), "zarr_format", 2) == 2


def _major(zarr: object) -> int:
    return int(zarr.__version__.split(".")[0])


FORMATS.register("zarr")(DiffusionPolicy())
