"""Demonstrations: episodes played by experts, or deconstruction episodes reversed in time."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, get_args

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ba_torchrl.core import keys
from ba_torchrl.core.config import Source
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.generators import seeded_generator
from ba_torchrl.demonstrations.episodes import collect_episodes, is_success, success_rate
from ba_torchrl.demonstrations.time_reversal import (
    DeconstructionEnv,
    is_reversible,
    reverse_episode,
)
from ba_torchrl.envs.factory import make, make_vector_env
from ba_torchrl.envs.policies import expert_policy

SOURCES: tuple[Source, ...] = get_args(Source)


def collect_demonstrations(
    env: EnvBase,
    episodes: int,
    *,
    seed: int | None = None,
    source: Source = "expert",
    only_successful: bool = False,
    noise: float = 0.0,
    turn_noise: float = 0.0,
    turns: Sequence[int] = (),
    primitive: int | None = None,
    nearest_action: Callable[[Tensor], Tensor] | None = None,
    on_episode: Callable[[TensorDict], None] | None = None,
) -> list[TensorDict]:
    """Play episodes with the expert.

    Args:
        env: a vector of environments made with `source_config`.
        episodes: their number. Episodes that are dropped are replaced by others.
        seed: of the first episodes; environment i starts from ``seed + i``.
        source: "expert", or "deconstruction" for episodes reversed in time. Episodes that cannot be
            reversed are dropped; all others succeed.
        only_successful: drop episodes that did not reach the goal.
        noise: probability of executing a random action in place of the expert's, for the source
            "expert". The expert is then seen in states that it does not reach by itself (DART:
            Laskey et al., 2017).
        turn_noise: probability of random turns beside the expert's other components, likewise.
        turns: indices of the components that turn the gripper, `env.actions.turns`.
        primitive: index of the primitive of open-loop actions, which stays the expert's, see
            `env.actions.primitive`.
        nearest_action: maps the expert's and the random actions to those that are executed and
            recorded. A policy with discrete actions needs it; None for the identity.
        on_episode: called with each episode that is played when it ends, for progress bars.

    Returns:
        Episodes as TensorDicts [T], with the entries of an environment without ``expert``, and with
        ``expert_moves`` [T, K, A] of tasks whose expert gives equal moves. With noise of either
        kind, ``is_expert`` [T, 1] tells which executed actions are the expert's, and
        ``expert_action`` [T, A] is the expert's in every state.

    Raises:
        ConfigError: the source is unknown or cannot have noise, the noise is no probability, the
            action has no turns, or too few episodes succeed.
    """
    if source not in SOURCES:
        raise ConfigError(f"source: {source!r} is not one of {', '.join(SOURCES)}")
    check_noise(noise, source, "noise")
    check_turn_noise(turn_noise, source, turns, "turn_noise")
    add_noise = None
    if noise or turn_noise:
        add_noise = RandomActions(
            env,
            noise,
            0 if seed is None else seed,
            turn_probability=turn_noise,
            turns=turns,
            primitive=primitive,
        )

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        out = expert_policy(tensordict)
        if add_noise is not None:
            out = add_noise(out)
        if nearest_action is not None:
            for key in (keys.ACTION, keys.EXPERT_ACTION, keys.EXPERT_MOVES):
                if key in out:
                    out.set(key, nearest_action(out[key]))
        return out

    keep = is_success if only_successful else None
    if source == "deconstruction":
        keep = is_reversible
    played = collect_episodes(env, policy, episodes, seed=seed, on_episode=on_episode, keep=keep)
    if source == "deconstruction":
        return [reverse_episode(episode) for episode in played]
    same_action = () if add_noise is not None else (keys.EXPERT_ACTION,)
    others = (*same_action, *((keys.NEXT, key) for key in keys.OF_EXPERT))
    return [episode.exclude(*others) for episode in played]


class RandomActions:
    """Replaces the action by a random one in some steps, and flags the others as the expert's.

    TorchRL's ``EGreedyModule`` draws from the global generator and has no such flag.

    Args:
        env: whose actions are drawn, uniformly within the bounds.
        probability: of a random action.
        seed: of the draws.
        turn_probability: of an action that is random in some components only.
        turns: indices of these components.
        primitive: index of a component that is never drawn: whether the gripper holds something
            determines the primitive of open-loop actions, and the other one has no effect.
    """

    def __init__(
        self,
        env: EnvBase,
        probability: float,
        seed: int,
        *,
        turn_probability: float = 0.0,
        turns: Sequence[int] = (),
        primitive: int | None = None,
    ) -> None:
        self._space = env.action_spec.space
        self._probability = probability
        self._turn_probability = turn_probability
        self._is_turn = torch.zeros(env.action_spec.shape[-1], dtype=torch.bool, device="cpu")
        self._is_turn[list(turns)] = True
        self._is_drawn = torch.ones_like(self._is_turn)
        if primitive is not None:
            self._is_drawn[primitive] = False
        self._generator = seeded_generator(seed)

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action and ``is_expert`` of every environment."""
        action = tensordict[keys.ACTION]
        low, high = self._space.low, self._space.high
        drawn = low + (high - low) * self._draw(*action.shape)
        is_random = self._draw(len(action), 1) < self._probability
        replaced = is_random & self._is_drawn
        if self._turn_probability:
            turns = self._draw(len(action), 1) < self._turn_probability
            replaced = replaced | (turns & self._is_turn)
        tensordict.set(keys.ACTION, torch.where(replaced, drawn, action))
        return tensordict.set(keys.IS_EXPERT, ~replaced.any(dim=-1, keepdim=True))

    def _draw(self, *shape: int) -> Tensor:
        """Return uniform random numbers in [0, 1)."""
        return torch.rand(shape, generator=self._generator, device="cpu", dtype=torch.float32)


def check_noise(noise: float, source: Source, name: str) -> None:
    """Check that a probability of random actions is in [0, 1), and 0 without an expert."""
    if isinstance(noise, bool) or not isinstance(noise, int | float) or not 0 <= noise < 1:
        raise ConfigError(f"{name}: must be at least 0 and less than 1, got {noise!r}")
    if noise and source != "expert":
        raise ConfigError(f"{name}: demonstrations of the source {source!r} have no random actions")


def check_turn_noise(noise: float, source: Source, turns: Sequence[int], name: str) -> None:
    """Check a probability of random turns, indices of which must be among the components."""
    check_noise(noise, source, name)
    if noise and not turns:
        raise ConfigError(f"{name}: the actions have no turns; leave it at 0")


def source_config(source: Source) -> dict[str, Any]:
    """Return the keywords of `make_vector_env` with which a source makes its environments."""
    is_reversed = source == "deconstruction"
    return {"expert": True, "make": DeconstructionEnv if is_reversed else make}


class ExpertScores(NamedTuple):
    """Results of an expert."""

    success_rate: float
    mean_length: float
    """Steps of the episodes that reached the goal; nan if none did."""
    median_length: float
    """Median steps of these episodes."""


def expert_scores(
    task: str,
    episodes: int,
    *,
    seed: int,
    num_envs: int = 1,
    parallel: bool | None = False,
    **env: Any,
) -> ExpertScores:
    """Play episodes with a task's expert and return its results.

    Args:
        seed: of the first episodes; environment i starts from ``seed + i``.
        parallel: one process per environment; see `ba_torchrl.make_vector_env`.
    """
    envs = make_vector_env(
        task, num_envs, parallel=parallel, **{**env, "seed": seed, "expert": True}
    )
    try:
        played = collect_episodes(envs, expert_policy, episodes, seed=seed, results_only=True)
    finally:
        envs.close()
    solved = [episode for episode in played if is_success(episode)]
    lengths = [len(episode) for episode in solved] or [math.nan]
    return ExpertScores(success_rate(played), statistics.fmean(lengths), statistics.median(lengths))
