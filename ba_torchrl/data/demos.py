"""Demonstrations: episodes played by the tasks' experts."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torchrl
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from ba_torchrl import __version__
from ba_torchrl.config import ConfigError, EnvConfig, parse
from ba_torchrl.data.episodes import collect_episodes, is_success, mean_length, success_rate
from ba_torchrl.envs import keys
from ba_torchrl.envs.factory import make_vector

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
    state = (keys.PIXELS, keys.HOLDING)
    ends = (keys.REWARD, keys.DONE, keys.TERMINATED, keys.TRUNCATED, keys.FAULT)
    out = flat.select(*state, keys.ACTION, *((keys.NEXT, key) for key in (*state, *ends)))
    out[keys.IS_EXPERT] = torch.full((len(flat), 1), is_expert)
    return out


def collect_demonstrations(
    env: EnvBase,
    episodes: int,
    *,
    seed: int | None = None,
    only_successful: bool = False,
    on_episode: Callable[[TensorDict], None] | None = None,
) -> list[TensorDict]:
    """Let the expert play.

    Args:
        env: a vector of environments made with ``expert=True``.
        episodes: how many to play.
        seed: of the first episodes; environment i starts from ``seed + i``.
        only_successful: leave out episodes that did not reach the goal.
        on_episode: called with each episode when it ends, for progress bars.

    Returns:
        Episodes as TensorDicts [T].
    """
    played = collect_episodes(env, expert_policy, episodes, seed=seed, on_episode=on_episode)
    return [episode for episode in played if is_success(episode) or not only_successful]


class ExpertScores(NamedTuple):
    """How an expert did."""

    success_rate: float
    mean_length: float
    """Steps of the episodes that reached the goal; nan if none did."""


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
    return ExpertScores(success_rate(played), mean_length(solved) if solved else math.nan)


def save_demonstrations(
    path: str | Path,
    episodes: Sequence[TensorDict],
    *,
    task: str,
    env: dict[str, Any],
    seed: int,
) -> None:
    """Write episodes as one memory-mapped TensorDict, with what they were collected from.

    Args:
        path: a new folder.
        episodes: TensorDicts [T].
        task: id of the task.
        env: fields of `EnvConfig` that were given.
        seed: of the first episodes.

    Raises:
        ValueError: there are no episodes.
    """
    if not episodes:
        raise ValueError("there are no episodes to save")
    path = Path(path)
    numbered = [
        episode.set(_EPISODE, torch.full((len(episode), 1), number))
        for number, episode in enumerate(episodes)
    ]
    torch.cat(numbered).memmap(path, copy_existing=True)
    metadata = {
        "task": task,
        "env": _env_values(env),
        "seed": seed,
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
    try:
        metadata = json.loads((path / _METADATA_FILE).read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise ConfigError(f"no demonstrations at {path}: {error}") from None
    found = {"task": metadata["task"], **metadata["env"]}
    wanted = {"task": task, **_env_values(env)}
    differences = [
        f"{name}: collected with {found.get(name)!r}, needed {wanted.get(name)!r}"
        for name in sorted(found.keys() | wanted.keys())
        if found.get(name) != wanted.get(name)
    ]
    if differences:
        raise ConfigError(
            f"the demonstrations at {path} do not fit:\n  " + "\n  ".join(differences)
        )
    data = TensorDict.load_memmap(path)
    numbers = data[_EPISODE].squeeze(-1)
    return [data[numbers == number].exclude(_EPISODE) for number in numbers.unique()]


def _env_values(env: dict[str, Any]) -> dict[str, Any]:
    """Return every environment parameter that shapes the data, defaults filled in, as JSON."""
    values = parse(EnvConfig, env, "env").model_dump(mode="json", exclude={"seed", "expert"})
    return json.loads(json.dumps(values))
