"""Demonstrations: episodes played by the tasks' experts."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from ba_torchrl.data.episodes import collect_episodes, is_success
from ba_torchrl.envs import keys


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
    env: EnvBase, episodes: int, *, seed: int | None = None, only_successful: bool = False
) -> list[TensorDict]:
    """Let the expert play.

    Args:
        env: a vector of environments made with ``expert=True``.
        episodes: how many to play.
        seed: of the first episodes; environment i starts from ``seed + i``.
        only_successful: leave out episodes that did not reach the goal.

    Returns:
        Episodes as TensorDicts [T].
    """
    played = collect_episodes(env, expert_policy, episodes, seed=seed)
    return [episode for episode in played if is_success(episode) or not only_successful]
