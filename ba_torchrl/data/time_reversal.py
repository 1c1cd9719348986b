"""Time reversal: episodes that take a structure apart become demonstrations that build it.

`reverse_episode` works on recorded episodes, without a simulator. `replay_scores` measures whether
the reversed actions build the structure.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ba_torchrl.envs import keys
from ba_torchrl.envs.base import ManipulationEnv
from ba_torchrl.envs.factory import make

_ENDS = (
    keys.REWARD,
    keys.DONE,
    keys.TERMINATED,
    keys.TRUNCATED,
    keys.SUCCESS,
    keys.FAULT,
    keys.STEP_COUNT,
)
_EXTRA = (keys.UNDO_ACTION, keys.UNDO_IN_HAND, keys.CAN_UNDO, keys.EXPERT_ACTION)


def is_reversible(episode: TensorDictBase) -> bool:
    """Return whether the reverse of a deconstruction episode [T] builds the structure.

    The episode must succeed, each of its actions must move exactly one object and be invertible,
    and picks and places must alternate, starting with a pick and ending with a place.
    """
    holding = episode[keys.HOLDING].flatten().tolist()
    return (
        bool(episode[keys.NEXT, keys.SUCCESS][-1])
        and bool(episode[keys.NEXT, keys.CAN_UNDO].all())
        and holding == [i % 2 == 1 for i in range(len(holding))]
        and not bool(episode[keys.NEXT, keys.HOLDING][-1])
    )


def reverse_episode(episode: TensorDictBase) -> TensorDict:
    """Return a deconstruction episode [T] reversed in time, which builds the structure.

    It has the entries of an expert's episode. Observations are in reverse order, actions are the
    inverse actions, and in-hand images are those of the inverse picks. The last step completes the
    structure, has the reward and terminates.

    Args:
        episode: steps [T] of an environment with ``deconstruct=True``.

    Raises:
        ValueError: the episode is not `is_reversible`.
    """
    if not is_reversible(episode):
        raise ValueError("the episode cannot be reversed: an action moved no object, or several")
    steps = len(episode)
    following = episode[keys.NEXT]
    seen = [key for key in episode.keys() if key not in {*_ENDS, *_EXTRA, keys.ACTION, keys.NEXT}]  # noqa: SIM118 -- a TensorDict
    # the state before each reversed step is t + 1, the state after it is t; the last step first
    before, after = (side.select(*seen).flip(0).clone() for side in (following, episode))
    if keys.IN_HAND in seen:
        # the reversed episode picks the object held in state t from the scene of state t + 1
        shown = torch.where(
            episode[keys.HOLDING][..., None, None],
            following[keys.UNDO_IN_HAND],
            episode[keys.IN_HAND],
        )
        after[keys.IN_HAND] = shown.flip(0)
        before[keys.IN_HAND] = torch.cat([following[keys.IN_HAND][-1:], shown[1:].flip(0)])
    count = torch.arange(steps, device="cpu")[:, None]
    last = count == steps - 1
    never = torch.zeros_like(last)
    for state, number, at_goal in ((before, count, never), (after, count + 1, last)):
        state.update(
            {
                keys.STEP_COUNT: number,
                keys.SUCCESS: at_goal,
                keys.TERMINATED: at_goal.clone(),
                keys.DONE: at_goal.clone(),
                keys.TRUNCATED: never.clone(),
                keys.FAULT: never.clone(),
            }
        )
    after[keys.REWARD] = last.to(torch.float32)
    before[keys.ACTION] = following[keys.UNDO_ACTION].flip(0)
    before[keys.NEXT] = after
    return before


class ReplayScores(NamedTuple):
    """Results of reversed episodes that are replayed in the simulator."""

    reversible: float
    """Fraction of the deconstruction episodes that can be reversed."""
    success_rate: float
    """Fraction of the reversible episodes whose inverse actions reach the goal."""
    mean_length: float


def replay_scores(task: str, episodes: int, *, seed: int = 0, **config: Any) -> ReplayScores:
    """Play deconstruction episodes, each followed by its inverse actions from its last state.

    Args:
        task: id of a task with a structure.
        episodes: number of deconstruction episodes.
        seed: of the first episode.
        config: other fields of `EnvConfig`.
    """
    env = make(task, **{**config, "seed": seed, "deconstruct": True, "expert": True})
    lengths, reached = [], 0
    try:
        for _ in range(episodes):
            episode = env.rollout(
                env.max_steps, lambda td: td.set(keys.ACTION, td[keys.EXPERT_ACTION].clone())
            )
            if not is_reversible(episode):
                continue
            actions = reverse_episode(episode)[keys.ACTION]
            lengths.append(len(actions))
            reached += _play(env, actions)
    finally:
        env.close()
    kept = len(lengths)
    if not kept:
        return ReplayScores(0.0, 0.0, float("nan"))
    return ReplayScores(kept / episodes, reached / kept, sum(lengths) / kept)


def _play(env: ManipulationEnv, actions: Tensor) -> bool:
    """Return whether actions [T, A] build the structure, completed by the last one."""
    scene = env.scene
    deconstruction, scene.task = scene.task, scene.task.task
    try:
        steps = [env.step(TensorDict({keys.ACTION: action}))[keys.NEXT] for action in actions]
    finally:
        scene.task = deconstruction
    return [bool(step[keys.SUCCESS]) for step in steps] == [False] * (len(steps) - 1) + [True]
