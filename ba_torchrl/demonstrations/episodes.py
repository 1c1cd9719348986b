"""Complete episodes: a fixed number from each environment of a vector, or from transitions."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.carried import state_after
from ba_torchrl.envs.checks import check_policy
from ba_torchrl.envs.policies import Policy

logger = logging.getLogger(__name__)


RESULT_KEYS = (keys.REWARD, keys.SUCCESS, keys.FAULT, keys.TERMINATED, keys.TRUNCATED, keys.DONE)
"""Entries of a step that hold the result of an episode."""
LEAST_KEPT = 0.1
"""Least fraction of the episodes that must be kept."""
MAX_LOST = 100
"""Largest number of episodes that may be lost to faults, and the number of dropped ones from which
`LEAST_KEPT` applies."""

FAULTY_ATTEMPTS = 3
"""Attempts at an episode of a given seed until a fault is a failure."""


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

    Returns:
        Episodes as TensorDicts [T], in the order of the environments.

    Raises:
        ConfigError: the environment is no vector, a trained policy is for another one, or too few
            episodes are kept.
        RuntimeError: more than `MAX_LOST` episodes were lost to faults.
    """
    check_policy(policy, env)
    if len(env.batch_size) != 1:
        raise ConfigError(
            f"{env} is no vector; for a single one: make_vector_env(task, 1, parallel=False)"
        )
    (num_envs,) = env.batch_size
    wanted = quotas(episodes, num_envs)
    finished: list[list[TensorDict]] = [[] for _ in wanted]
    current: list[list[TensorDict]] = [[] for _ in wanted]
    lost = dropped = 0
    state = env.reset() if seed is None else _reset_with_seeds(env, seed)
    while any(len(done) < quota for done, quota in zip(finished, wanted, strict=True)):
        step, state = env.step_and_maybe_reset(policy(state))
        if results_only:
            step = _results(step)
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
                if lost > MAX_LOST:
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
            if dropped >= MAX_LOST and kept < LEAST_KEPT * (kept + dropped):
                raise ConfigError(
                    f"only {kept} of {kept + dropped} episodes succeed, {episodes} are needed; "
                    "take failed ones too, less noise or another source"
                )
    return [episode for done in finished for episode in done]


def _reset_with_seeds(env: EnvBase, seed: int) -> TensorDictBase:
    """Reset environment i with ``seed + i``."""
    vector = env
    while isinstance(vector, TransformedEnv):
        vector = vector.base_env
    if isinstance(vector, BatchedEnvBase):  # it would give all environments the same seed
        return env.reset(list_of_kwargs=[{"seed": seed + i} for i in range(vector.num_workers)])
    return env.reset(seed=seed)


@torch.no_grad()
def play_seeds(
    env: EnvBase,
    policy: Policy,
    seeds: Sequence[int],
    on_episode: Callable[[TensorDict], None] | None = None,
) -> list[TensorDict]:
    """Play the episode of each seed, in which all objects are new.

    An environment that has ended an episode takes the next seed. An episode with a fault is played
    again, at most `FAULTY_ATTEMPTS` times in all; the last attempt is then a failed episode.

    Args:
        env: a vector of environments, batch size [num_envs].
        policy: writes the action.
        seeds: of the episodes.
        on_episode: called with each episode when it ends, for progress bars.

    Returns:
        Episodes as TensorDicts [T] with the actions and the entries of `RESULT_KEYS`, in the order
        of ``seeds``.
    """
    check_policy(policy, env)
    (num_envs,) = env.batch_size
    waiting = deque((number, 1) for number in range(len(seeds)))
    current: list[tuple[int, int] | None] = [None] * num_envs
    steps: list[list[TensorDict]] = [[] for _ in current]
    finished: dict[int, TensorDict] = {}
    state: TensorDictBase | None = None
    while len(finished) < len(seeds):
        idle = [i for i, playing in enumerate(current) if playing is None]
        begins = idle[: len(waiting)]
        if begins:
            options: list[dict[str, Any]] = [{} for _ in current]
            for i in begins:
                current[i] = waiting.popleft()
                options[i] = {"seed": seeds[current[i][0]]}
            if state is not None:  # the first reset is of all environments
                state.set("_reset", _mask(begins, num_envs))
            carried = None if state is None else state.get(keys.CARRIED, None)
            state = env.reset(state, list_of_kwargs=options)
            if carried is not None:
                state.set(keys.CARRIED, carried)
        playing = [i for i, each in enumerate(current) if each is not None]
        step = env.step(policy(state).set("_step", _mask(playing, num_envs).squeeze(-1)))
        state = state_after(step)
        for i, transition in enumerate(_results(step).unbind(0)):
            if current[i] is None:
                continue
            steps[i].append(transition.clone())
            following = transition[keys.NEXT]
            if not following[keys.DONE]:
                continue
            (number, attempt), current[i] = current[i], None
            episode, steps[i] = torch.stack(steps[i]), []
            if following[keys.FAULT] and attempt < FAULTY_ATTEMPTS:
                logger.warning("the episode of seed %d had a fault and is repeated", seeds[number])
                waiting.appendleft((number, attempt + 1))
                continue
            finished[number] = episode
            if on_episode is not None:
                on_episode(episode)
    return [finished[number] for number in range(len(seeds))]


def _results(step: TensorDictBase) -> TensorDictBase:
    """Return the actions of a step and the entries of `RESULT_KEYS`."""
    results = ((keys.NEXT, key) for key in RESULT_KEYS)
    return step.select(keys.ACTION, keys.EXPERT_ACTION, *results, strict=False)


def _mask(indices: Sequence[int], num_envs: int) -> torch.Tensor:
    """Return which environments are among some, [num_envs, 1]."""
    mask = torch.zeros(num_envs, 1, dtype=torch.bool, device="cpu")
    mask[list(indices)] = True
    return mask


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
    """Holds transitions back until their episodes end.

    Where the next step of an episode is missing, as after the replacement of a worker, the part
    before counts as an unsuccessful episode, and the part after as another episode.
    """

    def __init__(self) -> None:
        self._running: dict[int, list[TensorDictBase]] = {}

    def __len__(self) -> int:
        """Number of transitions of the episodes that have not ended."""
        return sum(map(len, self._running.values()))

    def complete(self, data: TensorDictBase) -> list[TensorDictBase]:
        """Add transitions, and return the episodes [T] that have ended, in that order.

        Args:
            data: [N], those of an environment in their order, with ``env_index``, ``step_count``
                and, under "next", ``done``.
        """
        ended = []
        for row in range(len(data)):
            transition = data[row : row + 1].clone()
            index = int(transition[keys.ENV_INDEX])
            running = self._running.setdefault(index, [])
            if running and transition[keys.STEP_COUNT] != running[-1][keys.STEP_COUNT] + 1:
                ended.append(torch.cat(running))
                running = self._running[index] = []
            running.append(transition)
            if bool(transition[keys.NEXT, keys.DONE]):
                ended.append(torch.cat(self._running.pop(index)))
        return ended

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
