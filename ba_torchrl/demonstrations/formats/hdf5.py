"""HDF5 files in robomimic's layout."""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
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
from ba_torchrl.envs.registration import gym_id

_GYM_TYPE = 2
"""robomimic's number for environments of Gymnasium."""
_OBS, _NEXT_OBS = "obs/", "next_obs/"
_LANGUAGE = "ep_meta/lang"
"""robomimic's name of the instruction, in an attribute of the episode."""
_VALID_EVERY = 10
"""Every tenth episode is for validation: as many as in robomimic's own split."""


class Robomimic(Format):
    """``data/demo_0/{obs,next_obs,actions,rewards,dones}``, channels last, and
    ``mask/{train,valid}``, the names of the episodes to learn from and of those to validate on."""

    channels_last = True
    package = "h5py"
    tag = "robomimic"
    suffixes = (".hdf5", ".h5")

    def matches(self, path: Path) -> bool:
        """Return whether it is a file with the suffix of HDF5."""
        return os.path.isfile(path) and path.suffix.lower() in self.suffixes

    def names(self, entries: Mapping[str, Entry]) -> dict[str, str]:
        """Return names: ``obs/depth``, ``actions``, ``rewards``, and other keys unchanged."""
        fixed = {keys.ACTION: "actions", keys.REWARD: "rewards", keys.INSTRUCTION: _LANGUAGE}
        return {
            key: fixed.get(key, f"{_OBS}{key}" if entry.role == "observation" else key)
            for key, entry in entries.items()
        }

    def file_shape(self, entry: Entry) -> tuple[int, ...]:
        """Return the shape of a step: results are numbers."""
        return () if entry.role == "result" else super().file_shape(entry)

    def write(self, path: Path, episodes: Sequence[Arrays], card: Card) -> None:
        """Write one file, built in memory: HDF5 ends the process if its own file cannot grow."""
        h5py = self.library("h5py")
        results = {entry.name for entry in card.entries.values() if entry.role == "result"}
        env_args = {"env_name": gym_id(card.task), "type": _GYM_TYPE, "env_kwargs": card.env}
        content = io.BytesIO()
        with h5py.File(content, "w") as file:
            data = file.create_group("data")
            data.attrs["env_args"] = json.dumps(env_args)
            data.attrs["total"] = card.steps
            for i, arrays in enumerate(episodes):
                demo = data.create_group(f"demo_{i}")
                dones = arrays[keys.TERMINATED] | arrays[keys.TRUNCATED]
                demo.attrs["num_samples"] = len(dones)
                demo["dones"] = dones[:, 0].astype(np.int64)
                for name, values in arrays.items():
                    if name == _LANGUAGE:
                        demo.attrs["ep_meta"] = json.dumps({"lang": str(values[0])})
                    elif name.startswith(_OBS):
                        _store(demo, name, values[:-1])
                        _store(demo, name.replace(_OBS, _NEXT_OBS, 1), values[1:])
                    else:
                        _store(demo, name, values[:, 0] if name in results else values)
            for name, demos in _split(len(episodes)).items():
                file[f"mask/{name}"] = np.array(demos, dtype="S")
        path.write_bytes(content.getbuffer())

    def read(self, path: Path) -> list[StoredArrays]:
        """Read every group of ``data``; ``obs`` gets its last row from ``next_obs``."""
        h5py = self.library("h5py")
        episodes = []
        with h5py.File(path, "r") as file:
            data = file["data"]
            demos = [name for name in data if isinstance(data.get(name), h5py.Group)]
            for demo in sorted(demos, key=lambda name: (len(name), name)):
                datasets = dict(datasets_below(data[demo]))
                arrays: dict[str, Any] = {}
                for name, dataset in datasets.items():
                    arrays[name] = _rows(h5py, dataset)
                    following = datasets.get(name.replace(_OBS, _NEXT_OBS, 1))
                    if name.startswith(_OBS) and following is not None:
                        arrays[name] = arrays[name].then(_rows(h5py, following, np.s_[-1:]))
                rows = sum(getattr(datasets.get("actions"), "shape", ())[:1])
                samples = data[demo].attrs.get("num_samples", rows)
                if rows and np.all(samples != rows):
                    raise ConfigError(
                        f"{path}: {demo} has {rows} actions, and its num_samples is {samples}"
                    )
                if language := _language(data[demo].attrs.get("ep_meta", "")):
                    arrays[_LANGUAGE] = np.array([language])
                episodes.append(arrays)
        return episodes


def _split(episodes: int) -> dict[str, list[str]]:
    """Return the names of the episodes for training and for validation, of one for training."""
    demos = [f"demo_{i}" for i in range(episodes)]
    step = max(min(_VALID_EVERY, episodes), 2)
    valid = demos[step - 1 :: step]
    parts = {"train": [demo for demo in demos if demo not in valid], "valid": valid}
    return {name: part for name, part in parts.items() if part}


def datasets_below(group: Any, above: tuple[Any, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yield the datasets below a group of h5py by their paths, links of any kind included.

    Args:
        above: the groups around it, which a link may name again.
    """
    above = (*above, group)
    for name in group:
        item = group.get(name)  # None for a link without a target
        if hasattr(item, "keys"):
            if item not in above:
                for below, dataset in datasets_below(item, above):
                    yield f"{name}/{below}", dataset
        elif hasattr(item, "shape"):
            yield name, item


def _rows(h5py: Any, dataset: Any, part: Any = ()) -> Rows:
    """Return a dataset, or a part of it, that is read later, from the file that has it."""
    file, name = dataset.file.filename, dataset.name

    def read() -> Any:
        with h5py.File(file, "r") as opened:
            return opened[name][part]

    return Rows(dataset.shape or (), dataset.dtype, read, unwritten(dataset))


def unwritten(dataset: Any) -> str:
    """Return why a dataset of h5py cannot be used: HDF5 reads parts that were never written as its
    fill value; empty if all of it was written."""
    if not dataset.size:  # None for a dataset without a value
        return ""
    if dataset.external:
        return f"the values of {dataset.name} are in other files, which are not read; copy them in"
    if dataset.is_virtual:
        return _unwritten_of_sources(dataset)
    if dataset.chunks is None:
        parts, written = 1, int(dataset.id.get_storage_size() > 0)
    else:
        sides = zip(dataset.shape, dataset.chunks, strict=True)
        parts = math.prod(-(-length // side) for length, side in sides)
        written = dataset.id.get_num_chunks()
    if written >= parts:
        return ""
    return (
        f"{parts - written} of {parts} parts of {dataset.name} were never written, as by a program "
        f"that was stopped; HDF5 reads them as {dataset.fillvalue}. Copy the file again, or delete "
        f"the episode. If they are meant: h5py.File(FILE, 'r+')['{dataset.name}'][:] = the values"
    )


def _unwritten_of_sources(dataset: Any) -> str:
    """Return why a virtual dataset cannot be used; see `unwritten`."""
    import h5py

    mapped = 0
    for source in dataset.virtual_sources():
        name = dataset.file.filename
        if source.file_name != ".":
            name = os.path.join(os.path.dirname(name), source.file_name)
        try:
            with h5py.File(name, "r") as file:
                fault = unwritten(file[source.dset_name])
        except (OSError, KeyError):
            fault = f"{source.dset_name} of {name}, a part of {dataset.name}, is missing"
        if fault:
            return fault
        mapped += source.vspace.get_select_npoints()
    if mapped < dataset.size:
        return f"{dataset.size - mapped} of {dataset.size} values of {dataset.name} have no source"
    return ""


def _language(meta: str | bytes) -> str | None:
    """Return the instruction in robomimic's ``ep_meta``; None if there is none."""
    try:
        values = json.loads(meta)
    except (ValueError, TypeError):  # empty, or no text
        return None
    return values.get("lang") if isinstance(values, dict) else None


def _store(group: object, name: str, values: np.ndarray) -> None:
    """Write an array, images one compressed chunk per step."""
    is_image = values.ndim > 2
    options = {"compression": "gzip", "chunks": (1, *values.shape[1:])} if is_image else {}
    group.create_dataset(name, data=values, **options)


FORMATS.register("hdf5")(Robomimic())
