"""LeRobot's data sets."""

from __future__ import annotations

import functools
import json
import os
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError, DamagedFilesError
from ba_torchrl.demonstrations.formats.base import FORMATS, Arrays, Card, Entry, Format
from ba_torchrl.envs.settings import resolve_env

if TYPE_CHECKING:
    from ba_torchrl.envs.lerobot import PolicyView

_TASK, _DONE = "task", "next.done"
_VIDEO_BACKEND = "pyav"
"""The decoder that needs no FFmpeg on the system."""
_LOCAL = "local"
"""No version of LeRobot's format: of such a revision, LeRobot does not ask the Hub for versions."""
_OWN = ("index", "episode_index", "frame_index", "timestamp", "task_index")
"""Entries that LeRobot adds."""
_PREFIXES = {"observation": "exact.", "action": "", "result": "next."}


class LeRobot(Format):
    """Parquet files: vectors of float32 and PNG pictures, which LeRobot's policies train on.

    The observations themselves are in a file beside, with the one after the last action; pictures
    that are colours are in the data set alone.
    """

    has_last_observation = False
    has_pictures = True
    package = "lerobot"
    tag = "LeRobot"
    hint = (
        ". LeRobot needs Python 3.12 or later, and a torch below 2.12 in the place of a newer one: "
        "install it in an environment of its own"
    )

    def matches(self, path: Path) -> bool:
        """Return whether it is the folder of a data set."""
        return os.path.isfile(path / "meta" / "info.json")

    def names(self, entries: Mapping[str, Entry]) -> dict[str, str]:
        """Return names such as ``observation.images.rgb``, ``exact.depth`` and ``next.reward``."""
        from ba_torchrl.envs.lerobot import IMAGES  # imports torch

        return {
            key: _TASK
            if key == keys.INSTRUCTION
            else f"{IMAGES if _is_colour(entry) else _PREFIXES[entry.role]}{key}"
            for key, entry in entries.items()
        }

    def is_beside(self, entry: Entry) -> bool:
        """Return whether policies see other values than the observation's."""
        return entry.role == "observation" and entry.dtype != "str" and not _is_colour(entry)

    def write(self, path: Path, episodes: Sequence[Arrays], card: Card) -> None:
        """Write by `LeRobotDataset`, frame by frame."""
        datasets = self.library("lerobot.datasets.lerobot_dataset")
        view = _view(card)
        observed = {
            key: each.name
            for key, each in card.entries.items()
            if each.role == "observation" and each.dtype != "str"
        }
        stored = {
            each.name: {"dtype": each.dtype, "shape": each.shape, "names": None}
            for each in card.entries.values()
            if each.dtype != "str" and not self.is_beside(each)
        }
        flag = {"dtype": "bool", "shape": (1,), "names": None}
        dataset = datasets.LeRobotDataset.create(
            repo_id=f"ba_torchrl/{path.name}",
            fps=card.resolved_env.video_fps,
            features={**stored, **view.features, _DONE: flag},
            root=path,
            robot_type=card.robot,
            use_videos=False,
            video_backend=_VIDEO_BACKEND,
        )
        with _silent(self.library("datasets")):
            for arrays in episodes:
                values = {name: arrays[name] for name in stored}
                values |= view.read({key: arrays[name] for key, name in observed.items()})
                values[_DONE] = arrays["next.terminated"] | arrays["next.truncated"]
                for step in range(len(values[_DONE])):
                    frame: dict[str, Any] = {name: rows[step] for name, rows in values.items()}
                    frame[_TASK] = str(arrays[_TASK][step]) if _TASK in arrays else card.prompt
                    dataset.add_frame(frame)
                dataset.save_episode()
            dataset.finalize()
        for folder in sorted(path.rglob("*"), reverse=True):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()

    def page(self, card: Card) -> str:
        """Return what policies see, and the commands that train them."""
        return _page(_view(card), card)

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


def _is_colour(entry: Entry) -> bool:
    """Whether the data set holds the entry itself, as a PNG picture."""
    return entry.is_picture and entry.dtype == "uint8" and entry.shape[0] == 3


def _view(card: Card) -> PolicyView:
    """Return what policies see of the demonstrations."""
    from ba_torchrl.envs.factory import make  # imports torch
    from ba_torchrl.envs.lerobot import PolicyView

    observed = [key for key, entry in card.entries.items() if entry.role == "observation"]
    with closing(make(card.resolved_env)) as env:
        return PolicyView(env, observed, card.cameras)


@contextmanager
def _silent(datasets: Any) -> Iterator[None]:
    """Turn the progress bars of Hugging Face's library off."""
    was_silent = datasets.are_progress_bars_disabled()
    datasets.disable_progress_bars()
    try:
        yield
    finally:
        if not was_silent:
            datasets.enable_progress_bars()


_PAGE = """
## What policies see

| name | numbers, in this order | unit | frame |
|---|---|---|---|
{rows}

Flags are 0 or 1. Depth and heights are pictures of three equal channels. `observations.npz` has
every observation but colours without loss, with a row after the last action of each episode.

## Training

An episode has {length:.0f} steps on average. Both policies predict chunks of {horizon} actions and
execute {executed} of them. `DATA` is this folder.

```bash
{act}

{diffusion}
```

LeRobot's evaluation, and a test under BA-TorchRL's protocol:

```bash
{evaluate}
```
"""
_SHORT = 12
"""Mean length of an episode below which a chunk has 8 actions, not 16 (Chi et al., 2023)."""


def _page(view: PolicyView, card: Card) -> str:
    rows = []
    for name, feature in view.features.items():
        info = feature["info"]
        numbers = ", ".join(feature["names"])
        unit = info.get("unit", "0 to 255")
        if "of_0" in info:
            unit = f"{info['of_0']:g} m (0) to {info['of_255']:g} m (255)"
        if feature["dtype"] == "image":
            numbers = " x ".join(map(str, feature["shape"]))
        rows.append(f"| `{name}` | {numbers} | {unit} | {info['frame']} |")
    length = card.steps / card.episodes
    horizon = 8 if length < _SHORT else 16
    return _PAGE.format(
        rows="\n".join(rows),
        length=length,
        horizon=horizon,
        executed=horizon // 2,
        act=_command(
            "act",
            card,
            # from scratch, the backbone learns as fast as the rest
            [f"chunk_size={horizon}", "optimizer_lr=1e-4", "optimizer_lr_backbone=1e-4"],
            horizon,
        ),
        diffusion=_command(
            "diffusion",
            card,
            [
                f"horizon={horizon}",
                "use_group_norm=true",  # as in Chi et al. (2023) without pretrained weights
                "drop_n_last_frames=0",
                "do_mask_loss_for_padding=true",
                "down_dims=[128,256,512]",
            ],
            horizon,
        ),
        evaluate=_evaluation(card),
    )


def _command(policy: str, card: Card, settings: list[str], horizon: int) -> str:
    """Return the command that trains a policy of LeRobot."""
    settings = [
        f"type={policy}",
        *settings,
        f"n_action_steps={horizon // 2}",
        "pretrained_backbone_weights=null",
        "push_to_hub=false",
    ]
    name = card.task.rpartition("/")[2]
    words = [
        f"--dataset.repo_id=ba_torchrl/{name} --dataset.root=$DATA",
        " ".join(shlex.quote(f"--policy.{setting}") for setting in settings),
        f"--batch_size=32 --steps=5000 --output_dir=outputs/{policy}",
    ]
    return _lines("lerobot-train", words)


def _evaluation(card: Card) -> str:
    """Return the commands that evaluate a policy in the environment of the demonstrations."""
    usual = json.loads(resolve_env(card.task, {}).config.model_dump_json())
    parameters = {name: value for name, value in card.env.items() if usual[name] != value}
    env = [f"--env.type=ba_torchrl --env.task={card.task}"]
    if parameters:
        env.append(f"--env.parameters={shlex.quote(json.dumps(parameters))}")
    if card.cameras is not None:
        env.append(f"--env.cameras={shlex.quote(json.dumps(card.cameras))}")
    policy = "outputs/act/checkpoints/last/pretrained_model"
    words = [
        f"--policy.path={policy}",
        *env,
        "--eval.n_episodes=50 --eval.batch_size=5 --eval.use_async_envs=false",
    ]
    return _lines("lerobot-eval", words) + f"\nba-torchrl evaluate policy=lerobot:{policy}"


def _lines(command: str, words: list[str]) -> str:
    return " \\\n    ".join([command, *words])


FORMATS.register("lerobot")(LeRobot())
