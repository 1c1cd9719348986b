"""HDF5 files in robomimic's layout."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ba_torchrl.data.formats.base import FORMATS, Arrays, Card, Entry, Format, plain
from ba_torchrl.envs import keys
from ba_torchrl.envs.registration import gym_id

_GYM_TYPE = 2
"""robomimic's number for environments of Gymnasium."""
_OBS, _NEXT_OBS = "obs/", "next_obs/"
_LANGUAGE = "ep_meta/lang"
"""robomimic's name of the instruction, in an attribute of the episode."""


class Robomimic(Format):
    """``data/demo_0/{obs,next_obs,actions,rewards,dones}``, channels last."""

    channels_last = True
    package = "h5py"
    suffixes = (".hdf5", ".h5")

    def matches(self, path: Path) -> bool:
        """Return whether it is a file with the suffix of HDF5."""
        return os.path.isfile(path) and path.suffix.lower() in self.suffixes

    def names(self, entries: Mapping[str, Entry]) -> dict[str, str]:
        """Return names: ``obs/pixels``, ``actions``, ``rewards``, and other keys unchanged."""
        fixed = {keys.ACTION: "actions", keys.REWARD: "rewards", keys.INSTRUCTION: _LANGUAGE}
        return {
            key: fixed.get(key, f"{_OBS}{key}" if entry.role == "observation" else key)
            for key, entry in entries.items()
        }

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
        path.write_bytes(content.getbuffer())

    def read(self, path: Path) -> list[Arrays]:
        """Read every group of ``data``; ``obs`` gets its last row from ``next_obs``."""
        h5py = self.library("h5py")
        episodes = []
        with h5py.File(path, "r") as file:
            data = file["data"]
            for demo in sorted(data, key=lambda name: (len(name), name)):
                group, arrays = data[demo], {}
                group.visititems(
                    lambda name, item, arrays=arrays: (
                        arrays.update({name: plain(item[()])})
                        if isinstance(item, h5py.Dataset)
                        else None
                    )
                )
                for name in [name for name in arrays if name.startswith(_OBS)]:
                    following = arrays.get(name.replace(_OBS, _NEXT_OBS, 1))
                    if following is not None:
                        arrays[name] = np.concatenate([arrays[name], following[-1:]])
                language = json.loads(group.attrs.get("ep_meta", "{}")).get("lang")
                if language is not None:
                    arrays[_LANGUAGE] = np.array([language])
                episodes.append(arrays)
        return episodes


def _store(group: object, name: str, values: np.ndarray) -> None:
    """Write an array, images one compressed chunk per step."""
    is_image = values.ndim > 2
    options = {"compression": "gzip", "chunks": (1, *values.shape[1:])} if is_image else {}
    group.create_dataset(name, data=values, **options)


FORMATS.register("hdf5")(Robomimic())
