"""Complete episodes: a fixed number from each environment of a vector, or from transitions."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from ba_torchrl.envs import keys
from ba_torchrl.envs.checks import check_policy
from ba_torchrl.errors import ConfigError

logger = logging.getLogger(__name__)

Policy = Callable[[TensorDictBase], TensorDictBase]

RESULT_KEYS = (keys.REWARD, keys.SUCCESS, keys.FAULT, keys.TERMINATED, keys.TRUNCATED, keys.DONE)
"""Entries of a step that hold the result of an episode."""
LEAST_KEPT = 0.1
"""Least fraction of the episodes that must be kept."""


def quotas(episodes: int, num_envs: int) -> list[int]:
    """Return the number of episodes of each environment; the numbers differ by at most one."""
    return [episodes // num_envs + (i < episodes % num_envs) for i in range(num_envs)]


@torch.no_grad()
def collect_episodes(
    env: EnvBase,
    policy: Policy,
    episodes: int,
    *,
    seed: int | None = None,
    results_only: bool = False,
    on_episode: Callable[[TensorDict], None] | None = None,
    keep: Callable[[TensorDict], bool] | None = None,
    max_lost: int = 100,
) -> list[TensorDict]:
    """Play complete episodes, a fixed number in each environment.

    The number is fixed because the first episodes to finish are biased towards short ones. An
    episode with a fault, or one that is not kept, is dropped, and the environment plays another.

    Args:
        env: a vector of environments, batch size [num_envs].
        policy: writes the action.
        episodes: total number of episodes.
        seed: of the first episodes; environment i starts from ``seed + i``.
        results_only: keep only the actions and the entries of `RESULT_KEYS`.
        on_episode: called with each episode when it ends, for progress bars.
        keep: whether an episode counts; None if all do.
        max_lost: largest number of episodes that may be lost to faults, and the number of dropped
            ones from which `LEAST_KEPT` applies.

    Returns:
        Episodes as TensorDicts [T], in the order of the environments.

    Raises:
        ConfigError: a trained policy is for another environment, or too few episodes are kept.
        RuntimeError: more than ``max_lost`` episodes were lost to faults.
    """
    check_policy(policy, env)
    (num_envs,) = env.batch_size
    wanted = quotas(episodes, num_envs)
    finished: list[list[TensorDict]] = [[] for _ in wanted]
    current: list[list[TensorDict]] = [[] for _ in wanted]
    lost = dropped = 0
    state = env.reset() if seed is None else env.reset(seed=seed)
    while any(len(done) < quota for done, quota in zip(finished, wanted, strict=True)):
        step, state = env.step_and_maybe_reset(policy(state))
        if results_only:
            results = ((keys.NEXT, key) for key in RESULT_KEYS)
            step = step.select(keys.ACTION, keys.EXPERT_ACTION, *results, strict=False)
        for i, transition in enumerate(step.unbind(0)):
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
            if on_episode is not None:
                on_episode(episode)
            if keep is None or keep(episode):
                finished[i].append(episode)
                continue
            dropped += 1
            kept = sum(map(len, finished))
            if dropped >= max_lost and kept < LEAST_KEPT * (kept + dropped):
                raise ConfigError(
                    f"only {kept} of {kept + dropped} episodes succeed, {episodes} are needed; "
                    "take failed ones too, less noise or another source"
                )
    return [episode for done in finished for episode in done]


def is_success(episode: TensorDictBase) -> bool:
    """Return whether an episode [T] reached the goal."""
    return bool(episode[keys.NEXT, keys.SUCCESS][-1])


def success_rate(episodes: Sequence[TensorDictBase]) -> float:
    """Return the fraction of episodes that reached the goal."""
    return sum(map(is_success, episodes)) / len(episodes)


def mean_length(episodes: Sequence[TensorDictBase]) -> float:
    """Return the mean number of steps per episode."""
    return sum(len(episode) for episode in episodes) / len(episodes)


def mean_return(episodes: Sequence[TensorDictBase]) -> float:
    """Return the mean sum of an episode's rewards, without discount."""
    return sum(float(each[keys.NEXT, keys.REWARD].sum()) for each in episodes) / len(episodes)


class EpisodeAssembler:
    """Holds transitions back until their episodes end, and flags those of successful episodes.

    Where the next step of an episode is missing, as after the replacement of a worker, the part
    before counts as an unsuccessful episode, and the part after as another episode.
    """

    def __init__(self) -> None:
        self._running: dict[int, list[TensorDictBase]] = {}

    def __len__(self) -> int:
        """Number of transitions of the episodes that have not ended."""
        return sum(map(len, self._running.values()))

    def complete(self, data: TensorDictBase) -> TensorDictBase:
        """Add transitions, and return those of the episodes that have ended.

        Args:
            data: [N], those of an environment in their order, with ``env_index``, ``step_count``
                and, under "next", ``done`` and ``success``.

        Returns:
            [M] transitions in the order in which their episodes ended, with ``is_expert`` set
            where the episode was successful.
        """
        ended = []
        for row in range(len(data)):
            transition = data[row : row + 1].clone()
            index = int(transition[keys.ENV_INDEX])
            running = self._running.setdefault(index, [])
            if running and transition[keys.STEP_COUNT] != running[-1][keys.STEP_COUNT] + 1:
                ended.append(self._flagged(index, is_successful=False))
                running = self._running.setdefault(index, [])
            running.append(transition)
            if bool(transition[keys.NEXT, keys.DONE]):
                is_successful = bool(transition[keys.NEXT, keys.SUCCESS])
                ended.append(self._flagged(index, is_successful=is_successful))
        if ended:
            return torch.cat(ended)
        return (
            data[:0].clone().set(keys.IS_EXPERT, torch.zeros(0, 1, dtype=torch.bool, device="cpu"))
        )

    def _flagged(self, index: int, *, is_successful: bool) -> TensorDictBase:
        """Return an environment's episode, which has ended, with its flag."""
        episode = torch.cat(self._running.pop(index))
        return episode.set(
            keys.IS_EXPERT, torch.full((len(episode), 1), is_successful, device="cpu")
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the transitions of the episodes that have not ended, by environment."""
        return {
            str(index): torch.cat(running).flatten_keys("/").to_dict()
            for index, running in self._running.items()
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""
        self._running = {}
        for index, entries in state.items():
            episode = TensorDict(entries, batch_size=[len(entries[keys.STEP_COUNT])])
            self._running[int(index)] = list(episode.unflatten_keys("/").split(1))
