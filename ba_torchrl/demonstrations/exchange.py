"""Demonstrations in the formats of other libraries: export, and import of ours and of others'."""

from __future__ import annotations

import functools
import json
import logging
from collections.abc import Mapping, Sequence
from contextlib import closing
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import NonTensorStack, TensorDict, TensorDictBase

from ba_torchrl import __version__
from ba_torchrl.core import keys
from ba_torchrl.core.config import expanded
from ba_torchrl.core.errors import ConfigError, UnknownNameError
from ba_torchrl.demonstrations.episodes import mean_return, success_rate
from ba_torchrl.demonstrations.formats.base import (
    FORMATS,
    RESULTS,
    Arrays,
    Card,
    Entry,
    Format,
    Role,
    StoredArrays,
    check_files,
    check_rows,
    entry_of,
    find_format,
    naming_episode,
    read_card,
    read_file,
    write_file,
)
from ba_torchrl.demonstrations.formats.minari import check_neighbours
from ba_torchrl.demonstrations.mapping import MappedFile, entry_specs
from ba_torchrl.envs.description import summary
from ba_torchrl.envs.factory import make
from ba_torchrl.envs.lerobot import PolicyView
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.tasks.base import versions_of

logger = logging.getLogger(__name__)

_COUNTED = {*keys.STEP_FLAGS, keys.STEP_COUNT}
"""Entries of a state that follow from the results of the steps before it."""
_OWN = {*keys.OF_EXPERT} - {keys.EXPERT_ACTION}
"""Entries that no other library has."""
_MOST_INSTRUCTIONS = 20


def export_demonstrations(
    path: str | Path,
    episodes: Sequence[TensorDict],
    *,
    format: str,
    task: str,
    env: dict[str, Any],
    seed: int,
    source: str = "expert",
    policy: str = "",
    expert_version: int | None = None,
    observed: Sequence[str] | None = None,
    cameras: Sequence[str] | None = None,
) -> None:
    """Write episodes for another library, with a card beside them.

    Args:
        path: a new file or folder; of Minari's format, its name is the data set's id.
        episodes: TensorDicts [T], as `collect_demonstrations` and `load_demonstrations` return.
        format: "lerobot", "minari", "hdf5" (robomimic), "zarr" (Diffusion Policy) or another
            registered one.
        task: id of the task.
        env: fields of `EnvConfig` that were set.
        seed: of the first episodes.
        source: how the demonstrations were made, as for `save_demonstrations`.
        policy: which acted, in words.
        expert_version: of the task's expert when they were made; None for the present one.
        observed: keys of the observations that are written; None for all of them.
        cameras: of LeRobot's format, keys of the images that are pictures for policies; None for
            all images of one size.

    Raises:
        ConfigError: the format is unknown, its package missing or it has no pictures, ``path``
            exists or has not the format's suffix, an episode lacks an entry or has another shape,
            or a key or a camera is not observed.
        ValueError: there are no episodes.
    """
    form, path = FORMATS[format], Path(expanded(path))
    if not episodes:
        raise ValueError("there are no episodes to export")
    if form.suffixes and path.suffix.lower() not in form.suffixes:
        raise ConfigError(f"{path} could not be read back; end the path in {form.suffixes[0]}")
    if cameras is not None and not form.has_pictures:
        raise ConfigError(f"cameras: the format {format} has none; choose images by keys")
    check_episodes(episodes, task, env)
    roles = _chosen(_roles(episodes[0]), observed)
    with closing(make(task, **{**env, "seed": 0})) as made:
        pictures = PolicyView(made, list(roles), cameras).images if form.has_pictures else {}
    arrays = [_to_arrays(episode, roles) for episode in episodes]
    entries = {key: _entry(key, role, arrays[0][key]) for key, role in roles.items()}
    shapes = {key: entry.shape for key, entry in entries.items()}
    for number, each in enumerate(arrays):
        for key, shape in shapes.items():
            if each[key].shape[1:] != shape:
                found = f"the shape {list(each[key].shape[1:])}"
                raise ConfigError(f"episode {number}: {key} has {found}, needed {list(shape)}")
    for key in pictures:
        entries[key] = entries[key].model_copy(update={"is_picture": True})
    names = form.names(entries)
    for key, entry in entries.items():
        if entry.dtype == "str" and key != keys.INSTRUCTION and not form.holds_texts:
            raise ConfigError(
                f"{key}: the format {format!r} holds no text but {keys.INSTRUCTION}; leave it out "
                "of the observations, or use format='minari'"
            )
        named = entry.model_copy(update={"name": names[key]})
        entries[key] = named.model_copy(update={"file_shape": form.file_shape(named)})
    values, versions = env_values(task, env), versions_of(task)
    is_observed = keys.INSTRUCTION in roles
    texts = [str(each[keys.INSTRUCTION][0]) for each in arrays] if is_observed else []
    texts = list(dict.fromkeys(texts or [_instruction(task, env)]))
    card = Card(
        format=format,
        task=task,
        task_version=versions.task,
        expert_version=versions.expert if expert_version is None else expert_version,
        goal=summary(task),
        robot=values["robot"],
        source=source,
        policy=policy,
        seed=seed,
        env=values,
        episodes=len(episodes),
        steps=sum(len(episode) for episode in episodes),
        success_rate=success_rate(episodes),
        mean_return=mean_return(episodes),
        instructions=list(filter(None, texts))[:_MOST_INSTRUCTIONS],
        versions={"ba_torchrl": __version__, form.package: _version(form.package)},
        entries=entries,
        left_out=sorted(_roles(episodes[0]).keys() - roles.keys()),
        cameras=None if cameras is None else list(cameras),
    )
    write_file(form, path, arrays, card)
    check_neighbours(path.resolve().parent)


def _chosen(roles: dict[str, Role], observed: Sequence[str] | None) -> dict[str, Role]:
    """Return the roles of actions, results and the observations that are chosen."""
    if observed is None:
        return roles
    known = [key for key, role in roles.items() if role == "observation"]
    for key in observed:
        if key not in known:
            raise UnknownNameError("observation", key, known)
    return {key: role for key, role in roles.items() if key not in known or key in observed}


def check_episodes(episodes: Sequence[TensorDictBase], task: str, env: dict[str, Any]) -> None:
    """Raise `ConfigError` unless all episodes [T] have the entries of the first, and of the
    environment those and the shapes of its observations and actions."""
    with closing(make(task, **env)) as made:
        specs = entry_specs(made)
    roles = _roles(episodes[0])
    for number, episode in enumerate(episodes):
        if missing := {*roles, *specs} - set(_roles(episode)):
            raise ConfigError(
                f"episode {number} has no {', '.join(sorted(missing))}, as episode 0 or the "
                "environment has"
            )
        if not len(episode):
            raise ConfigError(f"episode {number} has no steps")
        for key, spec in specs.items():
            if episode[key].shape[1:] != spec.shape:
                found = f"the shape {list(episode[key].shape[1:])}"
                raise ConfigError(f"episode {number}: {key} has {found}, needed {list(spec.shape)}")


def _instruction(task: str, env: dict[str, Any]) -> str:
    """Return the goal as a sentence: the example of `describe`, with these parameters."""
    with closing(make(task, **{**env, "seed": 0})) as made:
        made.reset()
        return made.instruction


def import_demonstrations(
    path: Path,
    *,
    task: str,
    env: dict[str, Any],
    mapping: str | Path | Mapping[str, Any] | None,
) -> list[TensorDict]:
    """Read episodes from a file of another library's format.

    Args:
        path: a file or folder of a registered format.
        task: id of the task.
        env: fields of `EnvConfig` of the environments.
        mapping: by our keys, the names in somebody else's file: a YAML file, or its values. None
            for a file that `export_demonstrations` wrote. Without ``success``, every episode ends
            in one, or as its sparse rewards say; without ``terminated``, ``truncated`` and
            ``reward``, these follow from it, which only sparse rewards allow. An episode ends at
            its first success, terminated or truncated step; the steps after it are left out. If the
            observation after the last action is not in the file, the last one is repeated.

    Raises:
        ConfigError: task or parameters differ from those of the card; or an entry is missing, its
            type, shape or range is not that of the environment, or rewards and successes differ.
    """
    form = _format(path)
    if mapping is None:
        entries, episodes = _exported(form, path, task, env)
    else:
        episodes = MappedFile(form, path, resolve_env(task, env), mapping).read()
        entries = {key: _entry(key, _role(key), values) for key, values in episodes[0].items()}
    converted = []
    for number, arrays in enumerate(episodes):
        with naming_episode(path, number):
            converted.append(_to_episode(form, entries, arrays))
    return converted


def count_demonstrations(
    path: Path,
    *,
    task: str,
    env: dict[str, Any],
    mapping: str | Path | Mapping[str, Any] | None,
) -> int:
    """Return the number of episodes of a file, after the checks that need no values."""
    form = _format(path)
    if mapping is None:
        return len(_exported(form, path, task, env)[1])
    return MappedFile(form, path, resolve_env(task, env), mapping).count()


def _format(path: Path) -> Format:
    form = find_format(path)
    if form is None:
        if card := read_card(path):  # of an export that has lost a file
            check_files(path, card)
        raise ConfigError(f"no demonstrations at {path} in the formats {', '.join(FORMATS)}")
    return form


def _exported(
    form: Format, path: Path, task: str, env: dict[str, Any]
) -> tuple[dict[str, Entry], list[StoredArrays]]:
    """Return the entries and the episodes of a file of `export_demonstrations`."""
    card = read_card(path)
    if card is None:
        raise ConfigError(
            f"{path} was written by another program; say where its entries belong in a mapping "
            f"(demonstrations_mapping). It holds {_listed(read_file(form, path))}"
        )
    check_same_environment(path, task, env, vars(card))
    if card.left_out:
        with closing(make(task, **env)) as made:
            missing = sorted(entry_specs(made).keys() - card.entries.keys())
        if missing:
            raise ConfigError(
                f"{path} was exported without {', '.join(missing)}, which {task} observes: export "
                "it without keys"
            )
    check_files(path, card)
    episodes = read_file(form, path)
    if len(episodes) != card.episodes:
        raise ConfigError(f"{path} holds {len(episodes)} episodes, its card says {card.episodes}")
    return card.entries, episodes


def _entry(key: str, role: Role, values: np.ndarray) -> Entry:
    """Return the entry of an episode's values, named by its key."""
    dtype = "str" if values.dtype.kind == "U" else str(values.dtype)
    return Entry(name=key, role=role, dtype=dtype, shape=values.shape[1:])


def _role(key: str) -> Role:
    """Return the role of an entry of the environment."""
    if key in RESULTS:
        return "result"
    return "action" if key == keys.ACTION else "observation"


def _roles(episode: TensorDictBase) -> dict[str, Any]:
    """Return the role of each entry that a file holds."""
    following = set(episode[keys.NEXT].keys())
    roles: dict[str, Any] = {
        key: "observation" if key in following else "action"
        for key in sorted(set(episode.keys()) - _COUNTED - _OWN - {keys.NEXT})
    }
    return roles | dict.fromkeys(RESULTS, "result")


def _to_arrays(episode: TensorDictBase, roles: Mapping[str, Any]) -> Arrays:
    """Return an episode [T] as arrays by key, observations with the one after the last action."""
    following = episode[keys.NEXT]
    arrays = {}
    for key, role in roles.items():
        part = _to_array(following if role == "result" else episode, key)
        if role == "observation":
            part = np.concatenate([part, _to_array(following[-1:], key)])
        arrays[key] = part
    return arrays


def _to_array(tensordict: TensorDictBase, key: str) -> np.ndarray:
    values = tensordict.get(key)
    return values.numpy() if isinstance(values, torch.Tensor) else np.array(values.tolist())


def _to_episode(form: Format, entries: Mapping[str, Entry], arrays: StoredArrays) -> TensorDict:
    steps = sum(entry_of(arrays, entries[keys.ACTION].name).shape[:1])
    if not steps:
        raise ConfigError("there are no actions")
    now: dict[str, Any] = {}
    following: dict[str, Any] = {}
    for key, entry in entries.items():
        if entry.name not in arrays:
            raise ConfigError(f"the file has no {entry.name!r}, which its card names")
        stored, is_observed = entry_of(arrays, entry.name), entry.role == "observation"
        if entry.dtype != "str":  # before the values are read
            rows = sum(stored.shape[:1])
            has_first = not is_observed and form.has_row_before_first_step(entry.name)
            check_rows(entry.name, rows - (has_first and rows > steps), steps, is_observed)
        values = np.asarray(stored)
        if entry.dtype == "str":
            text = np.resize(values.astype(str).reshape(-1), steps + 1)
            now[key], following[key] = (
                NonTensorStack(*map(str, part)) for part in (text[:-1], text[1:])
            )
            continue
        if values.shape[1:] != entry.shape and entry.is_image:
            values = np.moveaxis(values, -1, 1)
        if values.shape[1:] != entry.shape:
            if (*values.shape[1:], 1) != entry.shape:
                raise ConfigError(
                    f"{entry.name} has the shape {values.shape[1:]}, its card says {entry.shape}"
                )
            values = values[..., None]
        if not is_observed and form.has_row_before_first_step(entry.name) and len(values) > steps:
            values = values[1:] if entry.role == "result" else values[:-1]
        rows = torch.from_numpy(np.array(values, dtype=entry.dtype))
        if is_observed:
            if len(rows) == steps:
                rows = torch.cat([rows, rows[-1:]])
            now[key], following[key] = rows[:-1], rows[1:].clone()
        else:
            (following if entry.role == "result" else now)[key] = rows
    following |= {
        keys.DONE: following[keys.TERMINATED] | following[keys.TRUNCATED],
        keys.FAULT: torch.zeros(steps, 1, dtype=torch.bool, device="cpu"),
        keys.STEP_COUNT: torch.arange(1, steps + 1, device="cpu")[:, None],
    }
    for key in _COUNTED:
        now[key] = torch.cat([torch.zeros_like(following[key][:1]), following[key][:-1]])
    return TensorDict({**now, keys.NEXT: TensorDict(following, [steps])}, [steps])


def env_values(task: str, env: dict[str, Any]) -> dict[str, Any]:
    """Return every parameter that affects the data, defaults included, as JSON values."""
    config = resolve_env(task, env).config
    return json.loads(config.model_dump_json(exclude={"seed", "render", "expert", "expert_chunk"}))


def check_same_environment(
    path: Path, task: str, env: dict[str, Any], metadata: Mapping[str, Any]
) -> None:
    """Check that demonstrations have the task, its version and the parameters of a run.

    Another version of the expert is a warning, once.

    Args:
        metadata: of the demonstrations: task, versions, source and env.
    """
    versions = versions_of(task)
    of_task = {"task": metadata["task"], "task_version": metadata["task_version"]}
    # A field that is missing in the file was added later and has its default value.
    found = {**of_task, **env_values(task, {}), **metadata["env"]}
    wanted = {"task": task, "task_version": versions.task, **env_values(task, env)}
    differences = [
        f"{name}: collected with {found.get(name)!r}, needed {wanted.get(name)!r}"
        for name in sorted(found.keys() | wanted.keys())
        if found.get(name) != wanted.get(name)
    ]
    if differences:
        raise ConfigError(
            f"the demonstrations at {path} do not fit:\n  " + "\n  ".join(differences)
        )
    if metadata["source"] != "keyboard" and metadata["expert_version"] != versions.expert:
        _warn_of_expert(path, task, metadata["expert_version"], versions.expert)


@functools.cache
def _warn_of_expert(path: Path, task: str, found: int, here: int) -> None:
    logger.warning(
        "the demonstrations at %s are of version %d of the expert of %s, which has version %d here",
        path,
        found,
        task,
        here,
    )


def _listed(episodes: Sequence[StoredArrays]) -> str:
    first = episodes[0] if episodes else {}
    return ", ".join(f"{name} {list(first[name].shape[1:])}" for name in sorted(first)) or "nothing"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
