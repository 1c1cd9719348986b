"""Demonstrations: episodes played by the tasks' experts, or reversed from taking the goal apart."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import torch
import torchrl
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from ba_torchrl import __version__
from ba_torchrl.data.episodes import collect_episodes, is_success, success_rate
from ba_torchrl.data.time_reversal import is_reversible, reverse_episode
from ba_torchrl.envs import keys
from ba_torchrl.envs.factory import make_vector, resolve
from ba_torchrl.errors import ConfigError

Source = Literal["expert", "deconstruction"]
"""Where demonstrations come from."""
SOURCES: tuple[Source, ...] = get_args(Source)
_METADATA_FILE = "demonstrations.json"
_EPISODE = "episode"


def expert_policy(tensordict: TensorDictBase) -> TensorDictBase:
    """Write the expert's action; the environment must be made with ``expert=True``."""
    return tensordict.set(keys.ACTION, tensordict[keys.EXPERT_ACTION].clone())


def as_transitions(tensordict: TensorDictBase, *, is_expert: bool) -> TensorDict:
    """Return what the replay stores of a rollout, flattened to [N].

    Args:
        tensordict: transitions of any batch shape.
        is_expert: whether they are demonstrations.
    """
    flat = tensordict.reshape(-1)
    state = [key for key in (keys.PIXELS, keys.IN_HAND, keys.HOLDING) if key in flat]
    ends = (keys.REWARD, keys.DONE, keys.TERMINATED, keys.TRUNCATED, keys.FAULT)
    out = flat.select(*state, keys.ACTION, *((keys.NEXT, key) for key in (*state, *ends)))
    out[keys.IS_EXPERT] = torch.full((len(flat), 1), is_expert)
    return out


def collect_demonstrations(
    env: EnvBase,
    episodes: int,
    *,
    seed: int | None = None,
    source: Source = "expert",
    only_successful: bool = False,
    on_episode: Callable[[TensorDict], None] | None = None,
) -> list[TensorDict]:
    """Let the expert play.

    Args:
        env: a vector of environments made with ``expert=True``, and with ``deconstruct=True`` if
            that is the source.
        episodes: how many to play.
        seed: of the first episodes; environment i starts from ``seed + i``.
        source: "expert", or "deconstruction" for episodes reversed in time; of those, what cannot
            be reversed is always left out, and all that is left succeeds.
        only_successful: leave out episodes that did not reach the goal.
        on_episode: called with each episode when it ends, for progress bars.

    Returns:
        Episodes as TensorDicts [T], with what an environment without ``expert`` gives.

    Raises:
        ConfigError: the source is unknown.
    """
    if source not in SOURCES:
        raise ConfigError(f"source: {source!r} is not one of {', '.join(SOURCES)}")
    played = collect_episodes(env, expert_policy, episodes, seed=seed, on_episode=on_episode)
    if source == "deconstruction":
        return [reverse_episode(episode) for episode in played if is_reversible(episode)]
    return [
        episode.exclude(keys.EXPERT_ACTION, (keys.NEXT, keys.EXPERT_ACTION))
        for episode in played
        if is_success(episode) or not only_successful
    ]


def source_config(source: Source) -> dict[str, bool]:
    """Return the fields of `EnvConfig` that a source of demonstrations needs."""
    return {"expert": True, **({"deconstruct": True} if source == "deconstruction" else {})}


class ExpertScores(NamedTuple):
    """How an expert did."""

    success_rate: float
    mean_length: float
    """Steps of the episodes that reached the goal; nan if none did."""
    median_length: float
    """Likewise."""


def expert_scores(
    task: str, episodes: int, *, seed: int, num_envs: int = 1, parallel: bool = False, **env: Any
) -> ExpertScores:
    """Let a task's expert play and keep score.

    Args:
        task: id of the task.
        episodes: how many to play.
        seed: of the first episodes; environment i starts from ``seed + i``.
        num_envs: environments side by side.
        parallel: each in a process of its own.
        env: fields of `EnvConfig`.
    """
    envs = make_vector(
        task,
        num_envs,
        parallel=parallel,
        start_method="spawn",
        **{**env, "seed": seed, "expert": True},
    )
    try:
        played = collect_episodes(envs, expert_policy, episodes, seed=seed, exclude=[keys.PIXELS])
    finally:
        envs.close()
    solved = [episode for episode in played if is_success(episode)]
    lengths = [len(episode) for episode in solved] or [math.nan]
    return ExpertScores(success_rate(played), statistics.fmean(lengths), statistics.median(lengths))


def save_demonstrations(
    path: str | Path,
    episodes: Sequence[TensorDict],
    *,
    task: str,
    env: dict[str, Any],
    seed: int,
    source: Source = "expert",
) -> None:
    """Write episodes as one memory-mapped TensorDict, with what they were collected from.

    Args:
        path: a new folder.
        episodes: TensorDicts [T].
        task: id of the task.
        env: fields of `EnvConfig` that were given.
        seed: of the first episodes.
        source: where they come from.

    Raises:
        ValueError: there are no episodes.
        FileExistsError: the folder holds demonstrations.
    """
    if not episodes:
        raise ValueError("there are no episodes to save")
    path = Path(path)
    if (path / _METADATA_FILE).exists():
        raise FileExistsError(f"{path} holds demonstrations; choose another folder")
    numbered = [
        episode.copy().set(_EPISODE, torch.full((len(episode), 1), number))
        for number, episode in enumerate(episodes)
    ]
    torch.cat(numbered).memmap(path, copy_existing=True)
    metadata = {
        "task": task,
        "env": _env_values(task, env),
        "seed": seed,
        "source": source,
        "episodes": len(episodes),
        "versions": {
            "ba_torchrl": __version__,
            "torch": torch.__version__,
            "torchrl": torchrl.__version__,
        },
    }
    (path / _METADATA_FILE).write_text(json.dumps(metadata, indent=2) + "\n")


def load_demonstrations(path: str | Path, *, task: str, env: dict[str, Any]) -> list[TensorDict]:
    """Read episodes back, if they were collected from the same task and parameters.

    Args:
        path: folder that `save_demonstrations` wrote.
        task: id of the task they are for.
        env: fields of `EnvConfig` of the environments they are for.

    Raises:
        ConfigError: there are none at ``path``, or they come from other environments; the message
            names every difference.
    """
    path = Path(path)
    check_demonstrations(path, task=task, env=env)
    data = TensorDict.load_memmap(path)
    numbers = data[_EPISODE].squeeze(-1)
    return [data[numbers == number].exclude(_EPISODE) for number in numbers.unique()]


def check_demonstrations(path: str | Path, *, task: str, env: dict[str, Any]) -> None:
    """Check that there are demonstrations of the same task and parameters at ``path``.

    Args:
        path: folder that `save_demonstrations` wrote.
        task: id of the task they are for.
        env: fields of `EnvConfig` of the environments they are for.

    Raises:
        ConfigError: there are none, or they come from other environments; the message names every
            difference.
    """
    path = Path(path)
    try:
        metadata = json.loads((path / _METADATA_FILE).read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise ConfigError(f"no demonstrations at {path}: {error}") from None
    if not {"task", "env"} <= metadata.keys():
        raise ConfigError(f"{path / _METADATA_FILE} does not say what was collected")
    # Fields that came into being since had no other value than their default.
    found = {"task": metadata["task"], **_env_values(task, {}), **metadata["env"]}
    wanted = {"task": task, **_env_values(task, env)}
    differences = [
        f"{name}: collected with {found.get(name)!r}, needed {wanted.get(name)!r}"
        for name in sorted(found.keys() | wanted.keys())
        if found.get(name) != wanted.get(name)
    ]
    if differences:
        raise ConfigError(
            f"the demonstrations at {path} do not fit:\n  " + "\n  ".join(differences)
        )


def _env_values(task: str, env: dict[str, Any]) -> dict[str, Any]:
    """Return every environment parameter that shapes the data, defaults filled in, as JSON."""
    other = {"seed", "render", *source_config("deconstruction")}
    return json.loads(resolve(task, **env).model_dump_json(exclude=other))
