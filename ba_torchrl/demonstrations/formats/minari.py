"""Minari's data sets."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from inspect import signature
from pathlib import Path

import numpy as np

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.demonstrations.formats.base import (
    FORMATS,
    Arrays,
    Card,
    Entry,
    Format,
    StoredArrays,
    flatten,
    rows_of,
)
from ba_torchrl.demonstrations.formats.hdf5 import datasets_below, unwritten
from ba_torchrl.envs.registration import gym_id, register_task

logger = logging.getLogger(__name__)

_ROOT = "MINARI_DATASETS_PATH"
_OBSERVATIONS, _INFOS = "observations/", "infos/"
_OVERHEAD, _EMPTY = 1 << 13, 1 << 18
"""Most bytes of HDF5 beside the values of an entry of an episode, and of an empty file."""
_FIXED = {
    keys.ACTION: "actions",
    keys.REWARD: "rewards",
    keys.TERMINATED: "terminations",
    keys.TRUNCATED: "truncations",
}


class Minari(Format):
    """Dictionaries of observations in the environment's spaces; other entries are infos.

    The last part of the path is the data set's id, which ends in a version: ``picking-v0``.
    """

    package = "minari"
    tag = "minari"
    holds_texts = True
    before_first_step = _INFOS

    def matches(self, path: Path) -> bool:
        """Return whether it is the folder of a data set."""
        return os.path.isfile(path / "data" / "metadata.json")

    def names(self, entries: Mapping[str, Entry]) -> dict[str, str]:
        """Return names: ``observations/depth``, ``actions``, ``infos/success``."""
        observed = {
            key: entry.role == "observation" and entry.dtype != "str"
            for key, entry in entries.items()
        }
        return {
            key: _FIXED.get(key, f"{_OBSERVATIONS if is_observed else _INFOS}{key}")
            for key, is_observed in observed.items()
        }

    def file_shape(self, entry: Entry) -> tuple[int, ...]:
        """Return the shape of a step: rewards and ends are numbers."""
        is_number = entry.role == "result" and not entry.name.startswith(_INFOS)
        return () if is_number else super().file_shape(entry)

    def write(self, path: Path, episodes: Sequence[Arrays], card: Card) -> None:
        """Write by Minari, with an environment that `recover_environment` makes."""
        import gymnasium

        minari = self.library("minari")
        self.library("h5py")
        try:
            self.library("minari.dataset.minari_dataset").parse_dataset_id(path.name)
        except (ValueError, TypeError):  # TypeError: no version
            raise ConfigError(
                f"path: {path.name} is no id of a data set, such as picking-v0: letters, digits, _ "
                "and -, and a version"
            ) from None
        _check_space(path.parent, episodes)
        register_task(card.task)
        env = gymnasium.make(gym_id(card.task), **card.env)
        spaces = env.observation_space.spaces
        observed = _below(episodes[0], _OBSERVATIONS)
        try:
            if missing := observed.keys() - spaces.keys():
                raise ConfigError(
                    f"the Gymnasium environment does not observe {', '.join(sorted(missing))}"
                )
            buffers = [
                minari.data_collector.EpisodeBuffer(
                    id=i,
                    observations={
                        key: values.astype(spaces[key].dtype)
                        for key, values in _below(arrays, _OBSERVATIONS).items()
                    },
                    actions=arrays["actions"],
                    rewards=arrays["rewards"][:, 0],
                    terminations=arrays["terminations"][:, 0],
                    truncations=arrays["truncations"][:, 0],
                    infos={
                        entry.name.removeprefix(_INFOS): _info(entry, arrays[entry.name])
                        for entry in card.entries.values()
                        if entry.name.startswith(_INFOS)
                    },
                )
                for i, arrays in enumerate(episodes)
            ]
            create = minari.create_dataset_from_buffers
            # Minari 0.5.4 would store images as JPEG
            raw = (
                {"jpeg_encoding": False} if "jpeg_encoding" in signature(create).parameters else {}
            )
            with _datasets_at(path.resolve().parent), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of e-mail and web addresses that are not given
                dataset = create(
                    path.name,
                    buffers,
                    env=env,
                    eval_env=env,
                    observation_space=gymnasium.spaces.Dict({key: spaces[key] for key in observed}),
                    action_space=env.action_space,
                    algorithm_name=card.source,
                    author="BA-TorchRL",
                    description=f"{card.goal} Robot: {card.robot}.",
                    data_format="hdf5",
                    requirements=[f"ba-torchrl=={card.versions['ba_torchrl']}"],
                    **raw,
                )
                if card.env["reward"] == "sparse":  # a normalised score is the rate of success
                    scores = {"ref_min_score": 0.0, "ref_max_score": 1.0}
                    dataset.storage.update_metadata(scores)
        finally:
            env.close()

    def read(self, path: Path) -> list[StoredArrays]:
        """Read every episode; observations of a single space are named ``observations``.

        Those of nested spaces are named ``observations/a/b``.
        """
        minari = self.library("minari")
        storage = minari.dataset.minari_storage.MinariStorage.read(path / "data")
        self._check_complete(path / "data", storage.total_episodes)
        episodes = []
        for episode in minari.MinariDataset(storage).iterate_episodes():
            found = {
                name: values
                for place in (*_FIXED.values(), _OBSERVATIONS[:-1], _INFOS[:-1])
                for name, values in flatten(place, getattr(episode, place))
            }
            episodes.append({name: rows_of(values) for name, values in found.items()})
        return episodes

    def _check_complete(self, data: Path, total: int) -> None:
        """Check that the files have all episodes of the metadata, and all of their values."""
        file = data / "main_data.hdf5"
        if not file.is_file():  # Minari's other storage: a folder per episode
            found = sum(part.is_dir() and part.name.isdecimal() for part in data.iterdir())
        else:
            with self.library("h5py").File(file, "r") as opened:
                found = len(opened)
                for episode in opened:
                    for _, dataset in datasets_below(opened[episode]):
                        if fault := unwritten(dataset):
                            raise ConfigError(f"{file}: {fault}")
        if found != total:
            raise ConfigError(
                f"{data} holds {found} episodes, and its metadata.json counts {total} "
                "(total_episodes)"
            )


def _check_space(folder: Path, episodes: Sequence[Arrays]) -> None:
    """Check that the disk has room: HDF5 ends the process if its file cannot grow."""
    needed = sum(values.nbytes + _OVERHEAD for arrays in episodes for values in arrays.values())
    free = shutil.disk_usage(folder).free
    if free < needed + _EMPTY:
        what = f"{needed / 1e6:.1f} MB are needed, {free / 1e6:.1f} MB are free"
        raise OSError(errno.ENOSPC, f"{os.strerror(errno.ENOSPC)}: {what}", str(folder))


def _info(entry: Entry, values: np.ndarray) -> np.ndarray | list[str]:
    """Return an entry as Minari's infos, whose first row is that of the reset: T + 1 rows."""
    if entry.dtype == "str":
        return list(map(str, values))
    missing = np.zeros_like(values[:1])
    return np.concatenate([missing, values] if entry.role == "result" else [values, missing])


def check_neighbours(folder: Path) -> None:
    """Warn of folders beside Minari's data sets that `minari list` takes for data sets.

    Args:
        folder: with exports of any format.
    """
    exports = [path for path in sorted(folder.iterdir()) if (path / "data").is_dir()]
    sets = [path for path in exports if os.path.isfile(path / "data" / "metadata.json")]
    others = [path.name for path in exports if path not in sets and path.name[:1] != "."]
    if sets and others:
        logger.warning(
            "`minari list` fails with MINARI_DATASETS_PATH=%s, because it takes %s for a data set: "
            "export Minari's data sets to a folder of their own",
            folder,
            ", ".join(others),
        )


def _below(arrays: Arrays, place: str) -> Arrays:
    return {
        name.removeprefix(place): values
        for name, values in arrays.items()
        if name.startswith(place)
    }


@contextmanager
def _datasets_at(folder: Path) -> Iterator[None]:
    """Let Minari write its data sets into a folder."""
    before = os.environ.get(_ROOT)
    os.environ[_ROOT] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ[_ROOT]
        else:
            os.environ[_ROOT] = before


FORMATS.register("minari")(Minari())
