"""Demonstrations in the formats of other libraries: export, and import of ours and of others'."""

from __future__ import annotations

import functools
import json
import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import NonTensorStack, TensorDict, TensorDictBase
from torchrl.data import NonTensor, TensorSpec

from ba_torchrl import __version__
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.demonstrations.episodes import mean_return, success_rate
from ba_torchrl.demonstrations.formats.base import (
    FORMATS,
    RESULTS,
    Arrays,
    Card,
    DemonstrationMapping,
    Entry,
    Format,
    Role,
    StoredArrays,
    check_files,
    entry_of,
    find_format,
    plain,
    read_card,
    read_file,
    write_file,
)
from ba_torchrl.envs.description import summary
from ba_torchrl.envs.factory import make
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.tasks.base import versions_of

logger = logging.getLogger(__name__)

_COUNTED = {*keys.STEP_FLAGS, keys.STEP_COUNT}
"""Entries of a state that follow from the results of the steps before it."""
_NOT_OBSERVED = {*_COUNTED, keys.EXPERT_ACTION, keys.INSTRUCTION}
_MOST_INSTRUCTIONS = 20
_TOLERANCE = 1e-4
"""Part of a range by which values may exceed it, for rounding."""


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

    Raises:
        ConfigError: the format is unknown or its package missing, ``path`` exists or has not the
            format's suffix, or an episode lacks an entry or has another shape.
        ValueError: there are no episodes.
    """
    form, path = FORMATS[format], Path(path)
    if not episodes:
        raise ValueError("there are no episodes to export")
    if form.suffixes and path.suffix.lower() not in form.suffixes:
        raise ConfigError(f"{path} could not be read back; end the path in {form.suffixes[0]}")
    if os.path.lexists(path):
        raise ConfigError(f"{path} exists already; choose another path")
    roles = _roles(episodes[0])
    specs = _specs(task, env)
    for number, episode in enumerate(episodes):
        if missing := {*roles, *specs} - set(_roles(episode)):
            raise ConfigError(
                f"episode {number} has no {', '.join(sorted(missing))}, as episode 0 or the "
                "environment has"
            )
        if not len(episode):
            raise ConfigError(f"episode {number} has no steps")
    arrays = [_to_arrays(episode, roles) for episode in episodes]
    entries = {key: _entry(key, role, arrays[0][key]) for key, role in roles.items()}
    shapes = {key: entry.shape for key, entry in entries.items()}
    shapes |= {key: tuple(spec.shape) for key, spec in specs.items()}
    for number, each in enumerate(arrays):
        for key, shape in shapes.items():
            if each[key].shape[1:] != shape:
                found = f"the shape {list(each[key].shape[1:])}"
                raise ConfigError(f"episode {number}: {key} has {found}, needed {list(shape)}")
    names = form.names(entries)
    for key, entry in entries.items():
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
    )
    write_file(form, path, arrays, card)


def _instruction(task: str, env: dict[str, Any]) -> str:
    """Return the goal as a sentence: the example of `describe`, with these parameters."""
    made = make(task, **{**env, "seed": 0})
    try:
        made.reset()
        return made.instruction
    finally:
        made.close()


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
    if mapping is not None:
        return _mapped(form, path, task, env, DemonstrationMapping.parse(mapping))
    entries, episodes = _exported(form, path, task, env)
    return _to_episodes(form, path, entries, episodes)


def count_demonstrations(
    path: Path,
    *,
    task: str,
    env: dict[str, Any],
    mapping: str | Path | Mapping[str, Any] | None,
) -> int:
    """Return the number of episodes of a file, after the checks that need no values.

    Args:
        path: this and the others as for `import_demonstrations`.
        task: id of the task.
        env: fields of `EnvConfig`.
        mapping: of the entries of somebody else's file.
    """
    form = _format(path)
    if mapping is None:
        return len(_exported(form, path, task, env)[1])
    given = DemonstrationMapping.parse(mapping)
    specs = _mapped_specs(path, task, env, given)
    is_sparse = _is_sparse(task, env)
    episodes = read_file(form, path)
    for number, stored in enumerate(episodes):
        with _named(path, number):
            _fitted_entries(form, stored, given, specs, is_sparse, reads=False)
    return len(episodes)


def _format(path: Path) -> Format:
    form = find_format(path)
    if form is None:
        raise ConfigError(f"no demonstrations at {path} in the formats {', '.join(FORMATS)}")
    return form


@contextmanager
def _named(path: Path, number: int) -> Iterator[None]:
    """Begin the message of a `ConfigError` with the file and the episode."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{path}, episode {number}: {error}") from None


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
    check_files(path, card)
    episodes = read_file(form, path)
    if len(episodes) != card.episodes:
        raise ConfigError(f"{path} holds {len(episodes)} episodes, its card says {card.episodes}")
    return card.entries, episodes


def _mapped(
    form: Format, path: Path, task: str, env: dict[str, Any], mapping: DemonstrationMapping
) -> list[TensorDict]:
    """Return the episodes of somebody else's file, whose entries are those of the environment."""
    specs = _mapped_specs(path, task, env, mapping)
    is_sparse = _is_sparse(task, env)
    episodes = []
    for number, stored in enumerate(read_file(form, path)):
        with _named(path, number):
            episodes.append(_fitted_entries(form, stored, mapping, specs, is_sparse, reads=True))
    if not episodes:
        raise ConfigError(f"{path} holds no episodes")
    _warn_of_constants(path, episodes, specs)
    if keys.REWARD in mapping.entries and keys.SUCCESS not in mapping.entries:
        if not any(arrays[keys.REWARD].any() for arrays in episodes):
            logger.warning(
                "%s: the rewards are all 0, and every episode counts as a success: map success, or "
                "leave out reward, which follows from it",
                path,
            )
        elif is_sparse:
            for arrays in episodes:
                arrays[keys.SUCCESS] = arrays[keys.REWARD]
    steps = _steps(episodes)
    for number, arrays in enumerate(episodes):
        with _named(path, number):
            episodes[number] = _with_results(_until_end(arrays), task, env)
    if (left := _steps(episodes)) < steps:
        logger.warning(
            "%s: %d of %d steps are left out, those after the first success or end of an episode",
            path,
            steps - left,
            steps,
        )
    entries = {
        key: _entry(
            key,
            "result" if key in RESULTS else "action" if key == keys.ACTION else "observation",
            values,
        )
        for key, values in episodes[0].items()
    }
    return _to_episodes(form, path, entries, episodes)


def _mapped_specs(
    path: Path, task: str, env: dict[str, Any], mapping: DemonstrationMapping
) -> dict[str, TensorSpec]:
    """Return the specifications of an environment, for whose entries there is a source."""
    specs = _specs(task, env)
    wanted = {*specs, *RESULTS, keys.INSTRUCTION}
    if unknown := mapping.entries.keys() - wanted:
        raise ConfigError(
            f"{path}: the environment has no {', '.join(sorted(unknown))}. "
            f"Known: {', '.join(sorted(wanted))}"
        )
    needed = {*specs, *({keys.INSTRUCTION} & {*env_values(task, env)["observations"]})}
    if not _is_sparse(task, env):
        needed |= {keys.REWARD, keys.TERMINATED}
    if missing := needed - mapping.entries.keys():
        raise ConfigError(f"{path}: the mapping has no {', '.join(sorted(missing))}")
    return specs


def _is_sparse(task: str, env: dict[str, Any]) -> bool:
    return resolve_env(task, env).config.reward == "sparse"


def _fitted_entries(
    form: Format,
    stored: StoredArrays,
    mapping: DemonstrationMapping,
    specs: Mapping[str, TensorSpec],
    is_sparse: bool,
    *,
    reads: bool,
) -> Arrays:
    """Return the entries of an episode with the types and the shapes of the environment.

    Args:
        form: of the file.
        stored: entries of the file.
        mapping: their meaning.
        specs: of the environment.
        is_sparse: whether its reward is 1 on success, else 0.
        reads: False to check shapes only; the returned arrays have no rows.
    """
    arrays, rows = {}, {}
    for key, source in mapping.entries.items():
        try:
            found = entry_of(stored, source.source)
            shape = found.shape
            if not reads:
                found = plain(np.empty((0, *shape[1:]), found.dtype))
            values = source.values(np.asarray(found))
            if key in specs:
                values = _fitted(values, specs[key])
            elif key in RESULTS:
                values = _one_number(values)
                if key != keys.REWARD or is_sparse:
                    _check_zero_or_one(values)
            elif values.dtype.kind not in "US":
                raise ConfigError("is no text")
            arrays[key], rows[key] = values, sum((values.shape if reads else shape)[:1])
        except ConfigError as error:
            raise ConfigError(f"{key}: {error}") from None
    steps = rows[keys.ACTION]
    for key in arrays.keys() - {keys.INSTRUCTION}:
        name, is_result = mapping.entries[key].source, key in RESULTS
        if is_result and rows[key] == steps + 1 and _is_before_first_step(form, name):
            arrays[key], rows[key] = arrays[key][1:], steps
        _check_rows(key, rows[key], steps, not is_result and key != keys.ACTION)
    if not steps:
        raise ConfigError("there are no actions")
    return arrays


def _is_before_first_step(form: Format, name: str) -> bool:
    """Whether an entry of that name may have a row before the first step."""
    return form.before_first_step is not None and name.startswith(form.before_first_step)


def _warn_of_constants(
    path: Path, episodes: Sequence[Arrays], specs: Mapping[str, TensorSpec]
) -> None:
    """Warn of an action or an observation that is one number in the whole file."""
    for key, spec in specs.items():
        first = episodes[0][key].flat[0]
        if spec.dtype == torch.bool or key == keys.IN_HAND:  # which are often 0
            continue
        if all((arrays[key] == first).all() for arrays in episodes):
            logger.warning("%s: %s is %g in all steps; is it the right entry?", path, key, first)


def _steps(episodes: Sequence[Arrays]) -> int:
    return sum(len(arrays[keys.ACTION]) for arrays in episodes)


def _entry(key: str, role: Role, values: np.ndarray) -> Entry:
    """Return the entry of an episode's values, named by its key."""
    dtype = "str" if values.dtype.kind == "U" else str(values.dtype)
    return Entry(name=key, role=role, dtype=dtype, shape=values.shape[1:])


def _specs(task: str, env: dict[str, Any]) -> dict[str, TensorSpec]:
    """Return the specifications of an environment's observations and actions, by key."""
    made = make(task, **env)
    try:
        specs = {
            key: spec
            for key, spec in made.observation_spec.items()
            if key not in _NOT_OBSERVED and not isinstance(spec, NonTensor)
        }
        return {**specs, keys.ACTION: made.action_spec}
    finally:
        made.close()


def _fitted(values: np.ndarray, spec: TensorSpec) -> np.ndarray:
    """Return values with the type and the shape that an environment has.

    Numbers become flags where they exceed 0.5; channels of images may be last; an axis of one, for
    a channel or at the end, may be missing. Values beyond the range by no more than rounding are
    clipped.
    """
    shape = tuple(spec.shape)
    if values.ndim and (*values.shape[1:], 1) == shape:
        values = values[..., None]
    if values.ndim == 3 and (1, *values.shape[1:]) == shape:
        values = values[:, None]
    if values.shape[1:] != shape and len(shape) == 3 == values.ndim - 1:
        values = np.moveaxis(values, -1, 1)
    if values.shape[1:] != shape:
        raise ConfigError(f"has the shape {list(values.shape[1:])}, needed {list(shape)}")
    if values.dtype.kind not in "fiub" or not np.isfinite(values).all():
        raise ConfigError("has values that are no finite numbers")
    if spec.dtype == torch.bool:
        return values if values.dtype == bool else values > 0.5
    low, high = (getattr(spec.space, name, None) for name in ("low", "high"))
    if values.dtype.kind == "f" and not spec.dtype.is_floating_point:
        # Zeros alone are black in either range.
        if high is not None and (high == 255).all() and 0 < values.max(initial=0) <= 1:
            raise ConfigError("has values from 0 to 1, needed 0 to 255; set scale: 255")
        values = values.round()
    if low is not None and high is not None:
        slack = _TOLERANCE * (high - low).numpy()
        if (values < low.numpy() - slack).any() or (values > high.numpy() + slack).any():
            raise ConfigError(
                f"has values from {values.min():g} to {values.max():g}, needed "
                f"{low.min().item():g} to {high.max().item():g}; set scale and offset"
            )
        values = values.clip(low.numpy(), high.numpy())
    return values.astype(torch.empty(0, dtype=spec.dtype, device="cpu").numpy().dtype, copy=False)


def _one_number(values: np.ndarray) -> np.ndarray:
    """Return results of the steps as [T, 1]."""
    if values.dtype.kind not in "fiub" or not np.isfinite(values).all():
        raise ConfigError(
            "has values that are no finite numbers; needed one number per step: set components, "
            "or another source"
        )
    if not values.ndim or values.shape[1:] not in ((), (1,)):
        raise ConfigError(
            f"has the shape {list(values.shape[1:])}, needed one number per step; set components"
        )
    return values.reshape(-1, 1)


def _check_zero_or_one(values: np.ndarray) -> None:
    """Check that results are 0 or 1, but for rounding."""
    if (np.minimum(abs(values), abs(values - 1.0)) > _TOLERANCE).any():
        raise ConfigError(
            f"has values from {values.min():g} to {values.max():g}, needed 0 or 1; set scale and "
            "offset, or another source"
        )


def _check_rows(what: str, rows: int, steps: int, is_observed: bool) -> None:
    """Check that there is a row for each step, of observations perhaps also one after the last."""
    if rows - steps not in ((0, 1) if is_observed else (0,)):
        raise ConfigError(f"{what} has {rows} rows, and there are {steps} actions")


def _until_end(arrays: Arrays) -> Arrays:
    """Return an episode until its first step with a success or an end."""
    steps = len(arrays[keys.ACTION])
    marks = [arrays[key] > 0.5 for key in RESULTS if key in arrays and key != keys.REWARD]
    ends = np.flatnonzero(np.any(marks, axis=0)) if marks else ()
    if not len(ends):
        return arrays
    steps = int(ends[0]) + 1
    kept = {key: steps + (key not in (*RESULTS, keys.ACTION)) for key in arrays}
    return {
        key: values if key == keys.INSTRUCTION else values[: kept[key]]
        for key, values in arrays.items()
    }


def _with_results(arrays: Arrays, task: str, env: dict[str, Any]) -> Arrays:
    """Return an episode with the results of its steps, which its file may lack."""
    resolved = resolve_env(task, env)
    reward_kind = resolved.config.reward
    steps = len(arrays[keys.ACTION])
    is_last = np.arange(steps)[:, None] == steps - 1

    def flags(key: str, default: np.ndarray) -> np.ndarray:
        return arrays[key] > 0.5 if key in arrays else default

    success = flags(keys.SUCCESS, is_last)
    ends_at_limit = is_last & resolved.task_class.terminates_at_limit
    terminated = flags(keys.TERMINATED, success | ends_at_limit)
    if reward_kind == "sparse" or (reward_kind == "difference" and keys.SUCCESS in arrays):
        terminated = terminated | success
    ends = is_last & ~terminated  # also where the file marks no end
    truncated = flags(keys.TRUNCATED, ends) | ends
    reward = np.asarray(arrays.get(keys.REWARD, success), dtype=np.float32)
    if reward_kind == "sparse" and keys.SUCCESS in arrays:
        reward = reward.round()
        if (reward != success).any():
            step = int(np.flatnonzero(reward != success)[0])
            raise ConfigError(
                f"step {step} of {steps} has the reward {reward[step].item():g} and the success "
                f"{int(success[step].item())}; leave out reward, which follows from success"
            )
    results = (reward, terminated, truncated, success)
    out = arrays | dict(zip(RESULTS, results, strict=True))
    if keys.INSTRUCTION in arrays:
        texts = {*arrays[keys.INSTRUCTION].astype(str).reshape(-1).tolist()}
        if len(texts) != 1 or not all(texts):
            raise ConfigError(
                f"instruction: found {sorted(texts)[:3]}, needed one sentence that remains the "
                "same in an episode"
            )
        out[keys.INSTRUCTION] = np.array([*texts] * (steps + 1))
    return out


def _roles(episode: TensorDictBase) -> dict[str, Any]:
    """Return the role of each entry that a file holds."""
    following = set(episode[keys.NEXT].keys())
    roles: dict[str, Any] = {
        key: "observation" if key in following else "action"
        for key in sorted(set(episode.keys()) - _COUNTED - {keys.NEXT})
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


def _to_episodes(
    form: Format, path: Path, entries: Mapping[str, Entry], episodes: Sequence[StoredArrays]
) -> list[TensorDict]:
    """Return episodes [T] as training has them, from the entries of a file."""
    converted = []
    for number, arrays in enumerate(episodes):
        with _named(path, number):
            converted.append(_to_episode(form, entries, arrays))
    return converted


def _to_episode(form: Format, entries: Mapping[str, Entry], arrays: StoredArrays) -> TensorDict:
    steps = sum(entry_of(arrays, entries[keys.ACTION].name).shape[:1])
    if not steps:
        raise ConfigError("there are no actions")
    now: dict[str, Any] = {}
    following: dict[str, Any] = {}
    for key, entry in entries.items():
        if entry.name not in arrays:
            raise ConfigError(f"the file has no {entry.name!r}, which its card names")
        values = np.asarray(entry_of(arrays, entry.name))
        if entry.dtype == "str":
            text = np.resize(values.astype(str).reshape(-1), steps + 1)
            now[key], following[key] = (_as_text(part) for part in (text[:-1], text[1:]))
            continue
        if values.shape[1:] != entry.shape and entry.is_image:
            values = np.moveaxis(values, -1, 1)
        if values.shape[1:] != entry.shape:
            if (*values.shape[1:], 1) != entry.shape:
                raise ConfigError(
                    f"{entry.name} has the shape {values.shape[1:]}, its card says {entry.shape}"
                )
            values = values[..., None]
        is_observed = entry.role == "observation"
        if not is_observed and _is_before_first_step(form, entry.name) and len(values) > steps:
            values = values[1:] if entry.role == "result" else values[:-1]
        rows = torch.from_numpy(np.array(values, dtype=entry.dtype))
        _check_rows(entry.name, len(values), steps, is_observed)
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


def _as_text(values: np.ndarray) -> NonTensorStack:
    return NonTensorStack(*map(str, values))


def env_values(task: str, env: dict[str, Any]) -> dict[str, Any]:
    """Return every parameter that affects the data, defaults included, as JSON values."""
    config = resolve_env(task, env).config
    return json.loads(config.model_dump_json(exclude={"seed", "render", "expert"}))


def check_same_environment(
    path: Path, task: str, env: dict[str, Any], metadata: Mapping[str, Any]
) -> None:
    """Check that demonstrations have the task, its version and the parameters of a run.

    Another version of the expert is a warning, once.

    Args:
        path: of the demonstrations, for messages.
        task: id of the task of the run.
        env: fields of `EnvConfig` of the run.
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
