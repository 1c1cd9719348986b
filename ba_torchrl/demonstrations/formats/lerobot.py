"""LeRobot's data sets."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError, DamagedFilesError
from ba_torchrl.demonstrations.formats.base import FORMATS, Arrays, Card, Entry, Format

_STATES = ("proprio", keys.OBSERVATION, keys.HOLDING)
"""Keys of which the first one there is ``observation.state``."""
_STATE, _TASK, _DONE = "observation.state", "task", "next.done"
_VIDEO_BACKEND = "pyav"
"""The decoder that needs no FFmpeg on the system."""
_LOCAL = "local"
"""No version of LeRobot's format: of such a revision, LeRobot does not ask the Hub for versions."""
_OWN = ("index", "episode_index", "frame_index", "timestamp", "task_index")
"""Entries that LeRobot adds."""


class LeRobot(Format):
    """Parquet files with images in them: PNG for colours, float32 TIFF for depth."""

    has_last_observation = False
    package = "lerobot"
    tag = "LeRobot"
    hint = ". LeRobot needs Python 3.12 or later"

    def matches(self, path: Path) -> bool:
        """Return whether it is the folder of a data set."""
        return os.path.isfile(path / "meta" / "info.json")

    def names(self, entries: Mapping[str, Entry]) -> dict[str, str]:
        """Return names: ``observation.state``, ``observation.images.NAME`` and ``next.reward``."""
        state = next((key for key in _STATES if key in entries), None)
        fixed = {state: _STATE, keys.INSTRUCTION: _TASK}
        prefixes = {"observation": "observation.", "action": "", "result": "next."}
        return {
            key: fixed.get(key, f"{prefixes[entry.role]}{'images.' * _is_camera(entry)}{key}")
            for key, entry in entries.items()
        }

    def write(self, path: Path, episodes: Sequence[Arrays], card: Card) -> None:
        """Write by `LeRobotDataset`, frame by frame."""
        datasets = self.library("lerobot.datasets.lerobot_dataset")
        entries = {entry.name: entry for entry in card.entries.values() if entry.dtype != "str"}
        features = {name: _feature(entry) for name, entry in entries.items()}
        dataset = datasets.LeRobotDataset.create(
            repo_id=f"ba_torchrl/{path.name}",
            fps=card.resolved_env.video_fps,
            features={**features, _DONE: {"dtype": "bool", "shape": (1,), "names": None}},
            root=path,
            robot_type=card.robot,
            use_videos=False,
            video_backend=_VIDEO_BACKEND,
        )
        for arrays in episodes:
            values = {
                name: arrays[name].astype(features[name]["dtype"], copy=False)
                if features[name]["dtype"] != "image"
                else arrays[name]
                for name in entries
            }
            values[_DONE] = arrays["next.terminated"] | arrays["next.truncated"]
            for step in range(len(values[_DONE])):
                frame: dict[str, Any] = {name: rows[step] for name, rows in values.items()}
                frame[_TASK] = str(arrays[_TASK][step]) if _TASK in arrays else card.prompt
                dataset.add_frame(frame)
            dataset.save_episode()
        dataset.finalize()

    def read(self, path: Path) -> list[Arrays]:
        """Read by `LeRobotDataset`: depth in metres, colours as uint8."""
        dataset = self._local_dataset(path)
        cameras = set(dataset.meta.camera_keys) - set(dataset.meta.depth_keys)
        episodes: dict[int, list[dict[str, Any]]] = {}
        for i in range(len(dataset)):
            frame = dataset[i]
            episodes.setdefault(int(frame["episode_index"]), []).append(frame)
        total = dataset.meta.total_episodes
        if sorted(episodes) != list(range(total)):
            raise ConfigError(
                f"{path}: data/ has the episodes {_listed(episodes)}, and meta/info.json counts "
                f"{total} (total_episodes), which begin at 0"
            )
        return [
            _stacked(_in_order(path, number, episodes[number]), cameras) for number in range(total)
        ]

    def _local_dataset(self, path: Path) -> Any:
        """Return LeRobot's data set, of files of the folder only, which agree in their numbers."""
        metadata = self.library("lerobot.datasets.dataset_metadata").LeRobotDatasetMetadata
        datasets = self.library("lerobot.datasets.lerobot_dataset")
        name = f"ba_torchrl/{path.name}"
        try:
            meta = _local(metadata, "_pull_from_repo")(name, path, _LOCAL)
        except (FileNotFoundError, NotADirectoryError) as error:
            raise DamagedFilesError(
                f"{path} is incomplete: {error}; copy it again with all of its files"
            ) from None
        total = len(meta.episodes or ())
        if meta.total_episodes != total:
            raise ConfigError(
                f"{path}: meta/info.json counts {meta.total_episodes} episodes (total_episodes), "
                f"and meta/episodes has {total}"
            )
        for number in range(total):
            videos = [meta.get_video_file_path(number, key) for key in meta.video_keys]
            for file in (meta.get_data_file_path(number), *videos):
                if not (path / file).is_file():
                    raise DamagedFilesError(f"{path / file} is missing; copy it again")
        dataset = _local(datasets.LeRobotDataset, "_download")(
            name,
            root=path,
            revision=_LOCAL,
            depth_output_unit="m",
            video_backend=_VIDEO_BACKEND,
        )
        rows = len(dataset.hf_dataset)
        if len(dataset) != rows:
            raise ConfigError(
                f"{path}: meta/info.json counts {len(dataset)} frames (total_frames), and data/ "
                f"has {rows}"
            )
        return dataset


def _local(base: type, download: str) -> type:
    """Return a class of LeRobot that does not load from the Hub what the folder lacks.

    Raises:
        AttributeError: this release of LeRobot downloads by another method.
    """

    @functools.wraps(getattr(base, download))
    def refuse(self: Any, *_: object, **__: object) -> None:
        if isinstance(sys.exc_info()[1], OSError):  # of the file that is missing
            raise
        raise DamagedFilesError(
            f"{self.root} is incomplete: data/ lacks episodes of meta/; copy it again"
        )

    return type(base.__name__, (base,), {download: refuse})


def _in_order(path: Path, number: int, frames: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the frames of an episode in the order of their `frame_index`."""
    frames = sorted(frames, key=lambda frame: int(frame["frame_index"]))
    found = [int(frame["frame_index"]) for frame in frames]
    if found != list(range(len(frames))):
        raise ConfigError(
            f"{path}, episode {number}: frame_index is {_listed(found)}, needed each number from 0 "
            f"to {len(frames) - 1} once"
        )
    return frames


def _listed(numbers: Iterable[int]) -> str:
    """Return numbers in words, the first ones of many."""
    found = sorted(numbers)
    return ", ".join(map(str, found[:8])) + ", ..." * (len(found) > 8)


def _stacked(frames: list[dict[str, Any]], cameras: set[str]) -> Arrays:
    """Return the frames of an episode as arrays; numbers have a last axis of one."""
    arrays: Arrays = {}
    for name in frames[0].keys() - set(_OWN):
        values = [frame[name] for frame in frames]
        if isinstance(values[0], str):
            arrays[name] = np.array(values)
            continue
        rows = np.stack([value.numpy() for value in values])
        if name in cameras and rows.dtype.kind == "f":
            rows = (rows * 255).round().astype(np.uint8)
        arrays[name] = rows[:, None] if rows.ndim == 1 else rows
    return arrays


def _is_camera(entry: Entry) -> bool:
    """Whether LeRobot stores the entry as an image: a depth map, or colours."""
    return entry.is_image and (entry.shape[0], entry.dtype) in ((1, "float32"), (3, "uint8"))


def _feature(entry: Entry) -> dict[str, Any]:
    """Return LeRobot's declaration of an entry."""
    if _is_camera(entry):
        feature = {"dtype": "image", "shape": entry.shape, "names": ["channels", "height", "width"]}
        return feature | ({"info": {"is_depth_map": True}} if entry.dtype == "float32" else {})
    dtype = "float32" if entry.name == _STATE else entry.dtype
    return {"dtype": dtype, "shape": entry.shape, "names": None}


FORMATS.register("lerobot")(LeRobot())
