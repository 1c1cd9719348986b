"""Evaluation of the greedy policy."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl import make
from ba_torchrl.algorithms.acting import constant_weights
from ba_torchrl.core import keys
from ba_torchrl.demonstrations.episodes import collect_episodes, mean_length, success_rate
from ba_torchrl.envs.carried import state_after
from ba_torchrl.envs.checks import check_policy
from ba_torchrl.envs.policies import Policy
from ba_torchrl.envs.settings import ResolvedEnv
from ba_torchrl.record.video import FrameRecorder


@dataclass(frozen=True)
class Evaluation:
    """Result of an evaluation."""

    episodes: int
    success_rate: float
    """Fraction of episodes that reached the goal."""
    standard_error: float
    """Of the success rate (binomial)."""
    mean_length: float
    """Steps per episode, failures at their full length."""

    def scalars(self, prefix: str) -> dict[str, float]:
        """Return the figures by name, for loggers."""
        return {
            f"{prefix}/success_rate": self.success_rate,
            f"{prefix}/standard_error": self.standard_error,
            f"{prefix}/mean_length": self.mean_length,
        }


def acting_on(policy: TensorDictModuleBase, device: torch.device) -> Policy:
    """Return a policy for environments on the CPU, computed on ``device``."""
    if device.type == "cpu":
        return policy

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        seen = tensordict.select(*policy.in_keys, keys.CARRIED, strict=False).to(device)
        return tensordict.update(policy(seen).select(*policy.out_keys).cpu())

    return act


def evaluate(
    env: EnvBase,
    policy: Policy,
    episodes: int,
    seed: int,
    on_episode: Callable[[TensorDict], None] | None = None,
) -> Evaluation:
    """Play greedy episodes from a seed, as many per environment; the weights stay constant."""
    with set_exploration_type(ExplorationType.DETERMINISTIC), constant_weights():
        played = collect_episodes(
            env,
            policy,
            episodes,
            seed=seed,
            results_only=True,
            on_episode=on_episode,
        )
    rate = success_rate(played)
    error = math.sqrt(rate * (1 - rate) / len(played))
    return Evaluation(len(played), rate, error, mean_length(played))


@torch.no_grad()
def record_episodes(
    resolved: ResolvedEnv,
    policy: Policy | None,
    episodes: int,
    seed: int,
    hold_frames: int = 4,
    on_episode: Callable[[int, int, bool], None] = lambda number, steps, is_success: None,
) -> list[np.ndarray]:
    """Play greedy episodes and render every step, as a `FrameRecorder` with ``motion`` does.

    Args:
        resolved: the environment.
        policy: acts on an unbatched root TensorDict; None for random actions.
        episodes: their number.
        seed: of the first.
        hold_frames: repetitions of an episode's last image.
        on_episode: called with the number of each episode from 1, its steps, and its success.

    Returns:
        Images [H, W, 3] uint8 in the order of time.

    Raises:
        ConfigError: a trained policy is for another environment.
    """
    env = make(resolved, seed=seed)
    recorder = FrameRecorder(env, motion=True)
    act = env.rand_action if policy is None else policy
    try:
        check_policy(policy, env)
        with set_exploration_type(ExplorationType.DETERMINISTIC), constant_weights():
            for number in range(1, episodes + 1):
                state = env.reset()
                recorder.record()
                steps = 0
                while not state[keys.DONE]:
                    state = state_after(env.step(act(state)))
                    steps += 1
                    recorder.record()
                on_episode(number, steps, bool(state[keys.SUCCESS]))
                recorder.frames += [recorder.frames[-1]] * hold_frames
    finally:
        env.close()
    return recorder.frames
