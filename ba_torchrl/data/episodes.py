"""Whole episodes from a vector of environments, a fixed number from each."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from ba_torchrl.envs import keys

logger = logging.getLogger(__name__)

Policy = Callable[[TensorDictBase], TensorDictBase]


def quotas(episodes: int, num_envs: int) -> list[int]:
    """Return the number of episodes of each environment; they differ by at most one."""
    return [episodes // num_envs + (i < episodes % num_envs) for i in range(num_envs)]


@torch.no_grad()
def collect_episodes(
    env: EnvBase,
    policy: Policy,
    episodes: int,
    *,
    seed: int | None = None,
    exclude: Sequence[str] = (),
    on_episode: Callable[[TensorDict], None] | None = None,
    max_lost: int = 100,
) -> list[TensorDict]:
    """Play whole episodes, a fixed number in each environment.

    Taking the first episodes that finish would favour short ones. An episode with a fault is left
    out and replaced by one with the next seed.

    Args:
        env: a vector of environments, batch size [num_envs].
        policy: writes the action.
        episodes: number of episodes in all.
        seed: of the first episodes; environment i starts from ``seed + i``.
        exclude: entries to leave out, such as the pixels when only results are needed.
        on_episode: called with each episode when it ends, for progress bars.
        max_lost: number of faults that are tolerated.

    Returns:
        Episodes as TensorDicts [T], those of the first environment first.

    Raises:
        RuntimeError: more than ``max_lost`` episodes were lost to faults.
    """
    (num_envs,) = env.batch_size
    wanted = quotas(episodes, num_envs)
    finished: list[list[TensorDict]] = [[] for _ in wanted]
    current: list[list[TensorDict]] = [[] for _ in wanted]
    lost = 0
    state = env.reset() if seed is None else env.reset(seed=seed)
    while any(len(done) < quota for done, quota in zip(finished, wanted, strict=True)):
        step, state = env.step_and_maybe_reset(policy(state))
        kept = step.exclude(*exclude, *((keys.NEXT, key) for key in exclude)).unbind(0)
        for i, transition in enumerate(kept):
            if len(finished[i]) == wanted[i]:
                continue
            current[i].append(transition.clone())
            following = transition[keys.NEXT]
            if not following[keys.DONE]:
                continue
            steps, current[i] = current[i], []
            if following[keys.FAULT]:
                lost += 1
                logger.warning("an episode of environment %d was lost to a fault", i)
                if lost > max_lost:
                    raise RuntimeError(f"{lost} episodes were lost to faults; see the log")
                continue
            episode = torch.stack(steps)
            finished[i].append(episode)
            if on_episode is not None:
                on_episode(episode)
    return [episode for done in finished for episode in done]


def is_success(episode: TensorDictBase) -> bool:
    """Whether an episode [T] ended with the goal reached."""
    return bool(episode[keys.NEXT, keys.SUCCESS][-1])


def success_rate(episodes: Sequence[TensorDictBase]) -> float:
    """Return the share of episodes that reached the goal."""
    return sum(map(is_success, episodes)) / len(episodes)


def mean_length(episodes: Sequence[TensorDictBase]) -> float:
    """Return the mean number of steps."""
    return sum(len(episode) for episode in episodes) / len(episodes)
