"""Files of demonstrations: episodes, with the task and parameters of their environment."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import torchrl
from tensordict import NonTensorStack, TensorDict

from ba_torchrl import __version__
from ba_torchrl.core.config import expanded
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import (
    atomic_output,
    read_json,
    read_state,
    verify_checksums,
    write_checksums,
    write_state,
    write_text,
)
from ba_torchrl.demonstrations.episodes import mean_return, success_rate
from ba_torchrl.demonstrations.exchange import (
    check_episodes,
    check_same_environment,
    count_demonstrations,
    env_values,
    import_demonstrations,
)
from ba_torchrl.demonstrations.formats.base import find_format, read_card
from ba_torchrl.tasks.base import TASKS, versions_of

logger = logging.getLogger(__name__)

METADATA_FILE = "demonstrations.json"
_FORMAT = 3
_LENGTHS, _SEPARATOR = "episode_lengths", "."


def save_demonstrations(
    path: str | Path,
    episodes: Sequence[TensorDict],
    *,
    task: str,
    env: dict[str, Any],
    seed: int,
    source: str = "expert",
    policy: str = "",
) -> None:
    """Write episodes as one table of tensors, with their task and parameters.

    The folder appears when it is complete on the disk, with checksums of its files.

    Args:
        path: a new or empty folder.
        episodes: TensorDicts [T].
        task: id of the task.
        env: fields of `EnvConfig` that were set.
        seed: of the first episodes.
        source: how the demonstrations were made, such as "expert" or "keyboard"; of a graded set,
            its grade.
        policy: which acted, in words.

    Raises:
        ValueError: there are no episodes.
        FileExistsError: the folder already holds demonstrations.
        ConfigError: another process writes it, or the episodes have not the observations and
            actions of the task's environment.
    """
    if not episodes:
        raise ValueError("there are no episodes to save")
    path = Path(expanded(path))
    if path.exists() and any(path.iterdir()):
        raise FileExistsError(f"{path} is not empty; choose another folder")
    check_episodes(episodes, task, env)
    lengths = torch.tensor([len(episode) for episode in episodes], device="cpu")
    steps = torch.cat(list(episodes)).flatten_keys(_SEPARATOR)
    entries: dict[str, Any] = {}
    for key in steps.keys():  # noqa: SIM118 -- a TensorDict
        value = steps[key]  # an instruction is a string, or a list with one per step
        entries[key] = [value] * len(steps) if isinstance(value, str) else value
    versions = versions_of(task)
    metadata = {
        "format": _FORMAT,
        "task": task,
        "task_version": versions.task,
        "expert_version": versions.expert,
        "env": env_values(task, env),
        "seed": seed,
        "source": source,
        "policy": policy,
        "episodes": len(episodes),
        "success_rate": success_rate(episodes),
        "mean_return": mean_return(episodes),
        "versions": {
            "ba_torchrl": __version__,
            "torch": torch.__version__,
            "torchrl": torchrl.__version__,
        },
    }
    with atomic_output(path) as scratch:
        write_state(scratch, {**entries, _LENGTHS: lengths})
        write_text(scratch / METADATA_FILE, json.dumps(metadata, indent=2) + "\n")
        write_checksums(scratch)


def load_demonstrations(
    path: str | Path,
    *,
    task: str | None = None,
    env: dict[str, Any] | None = None,
    mapping: str | Path | Mapping[str, Any] | None = None,
) -> list[TensorDict]:
    """Read episodes, a TensorDict [T] each.

    Args:
        path: folder of `ba-torchrl collect` or `save_demonstrations`, or a file or folder of
            another library's format, as of `export_demonstrations`.
        task: id of the task that they must be of; None for any, of a folder of this package.
        env: fields of `EnvConfig` that they must have been collected with.
        mapping: of the entries of somebody else's file, see `import_demonstrations`.

    Raises:
        ConfigError: there are none at ``path``, their files are damaged, or task or parameters
            differ; the message names every difference. Without a task, another version of it is a
            warning.
    """
    path = Path(expanded(path))
    if not _is_own(path, mapping):
        if task is None:
            raise ConfigError(f"{path} is of another library: name the task and its env")
        return import_demonstrations(path, task=task, env=env or {}, mapping=mapping)
    if task is None:
        if version := _other_version(read_metadata(path)):
            logger.warning("the demonstrations at %s are of %s", path, version)
    else:
        check_demonstrations(path, task=task, env=env or {})
    return _read_episodes(path)


def read_demonstrations(path: str | Path) -> tuple[list[TensorDict], dict[str, Any]]:
    """Return the episodes of a folder that `save_demonstrations` wrote, and its metadata."""
    path = Path(expanded(path))
    if os.path.exists(path) and not os.path.exists(path / METADATA_FILE):
        raise ConfigError(
            f"no demonstrations of ours at {path}: a folder that `ba-torchrl collect` or "
            "`teleoperate` wrote is needed"
        )
    metadata = read_metadata(path)
    if version := _other_version(metadata):
        raise ConfigError(f"the demonstrations at {path} are of {version}; collect them again")
    return _read_episodes(path), metadata


def _other_version(metadata: dict[str, Any]) -> str | None:
    """Return the version of a known task in words, None if it is the present one."""
    task, found = metadata["task"], metadata["task_version"]
    if task not in TASKS or found == versions_of(task).task:
        return None
    return f"version {found} of {task}, which has version {versions_of(task).task} here"


def check_demonstrations(
    path: str | Path,
    *,
    task: str,
    env: dict[str, Any],
    least: int = 1,
    mapping: str | Path | Mapping[str, Any] | None = None,
) -> None:
    """Check that there are demonstrations of the same task and parameters at ``path``.

    Args:
        least: number of episodes that are needed.
    """
    path = Path(path)
    if _is_own(path, mapping):
        metadata = read_metadata(path)
        count = metadata["episodes"]
        check_same_environment(path, task, env, metadata)
    else:
        count = count_demonstrations(path, task=task, env=env, mapping=mapping)
    if count < least:
        raise ConfigError(f"{path} holds {count} episodes, {least} are needed")


def recorded_expert(
    path: str | Path, mapping: str | Path | Mapping[str, Any] | None = None
) -> int | None:
    """Return the version of the expert of demonstrations; None if it is not known."""
    path = Path(path)
    if not _is_own(path, mapping):
        return None
    metadata = read_metadata(path)
    return None if metadata["source"] == "keyboard" else metadata["expert_version"]


def _is_own(path: Path, mapping: object) -> bool:
    """Whether there is a folder that `save_demonstrations` wrote, or, unmapped, nothing known."""
    is_own = os.path.exists(path / METADATA_FILE)
    if is_own and mapping is not None:
        raise ConfigError(f"{path} has our entries; leave out the mapping (demonstrations_mapping)")
    if is_own or mapping is not None:
        return is_own
    return find_format(path) is None and read_card(path) is None


def read_metadata(path: Path) -> dict[str, Any]:
    """Return what a folder that `save_demonstrations` wrote says of its episodes."""
    try:
        metadata = read_json(path / METADATA_FILE)
    except FileNotFoundError:
        raise ConfigError(f"no demonstrations at {path}: there is no {METADATA_FILE}") from None
    except (OSError, ValueError, RecursionError) as error:
        reason = f"{METADATA_FILE} cannot be read: {error}"
        raise ConfigError(f"no demonstrations at {path}: {reason}") from None
    verify_checksums(path)
    if isinstance(metadata, dict) and metadata.get("format") != _FORMAT:
        raise ConfigError(
            f"{path} has not the format {_FORMAT} of this version; collect the demonstrations again"
        )
    kinds = {"task": str, "env": dict, "episodes": int, "source": str}
    kinds |= {"task_version": int, "expert_version": int}
    if not isinstance(metadata, dict) or any(
        not isinstance(metadata.get(name), kind) for name, kind in kinds.items()
    ):
        raise ConfigError(f"{path / METADATA_FILE} does not say what was collected")
    return metadata


def _read_episodes(path: Path) -> list[TensorDict]:
    state = read_state(path)
    try:
        lengths = state.pop(_LENGTHS).tolist()
        if not lengths or not all(map(_is_entry, state.values())):
            raise ValueError("there are none, or their entries are neither tensors nor sentences")
        entries = {
            key: NonTensorStack(*value) if isinstance(value, list) else value
            for key, value in state.items()
        }
        steps = TensorDict(entries, batch_size=[sum(lengths)]).unflatten_keys(_SEPARATOR)
        return [episode.clone() for episode in steps.split(lengths)]
    except (RuntimeError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path} does not hold episodes: {error}") from error


def _is_entry(value: Any) -> bool:
    """Return whether a value is a tensor, or a list of strings."""
    if isinstance(value, list):
        return bool(value) and all(isinstance(item, str) for item in value)
    return isinstance(value, torch.Tensor)
