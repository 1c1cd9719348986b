"""Environments and episodes of the contract checks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from ba_torchrl import make
from ba_torchrl.core import keys
from ba_torchrl.envs.base import BulletArmEnv
from ba_torchrl.tasks.base import TASKS, Task

IMAGE_SIZES = {"close_loop": 32, "open_loop": 128}
"""Image size by control. Open-loop picks take their height from the image, in which a
block must cover several pixels."""

MAX_EPISODE_STEPS = 60

RANDOM_STEPS = {"close_loop": 8, "open_loop": 2}
"""Number of random actions that disturb a scene, by control."""


def make_small(task: str, **config: Any) -> BulletArmEnv:
    """Make an environment with seed 0 and a small image."""
    size = IMAGE_SIZES[TASKS[task].control]
    return make(task, **{"obs_size": size, "seed": 0, **config})


def image_of(data: TensorDictBase) -> torch.Tensor:
    """Return the control's image in an observation, or in several."""
    return data[keys.DEPTH if keys.DEPTH in data else keys.HEIGHTMAP]


def continues(task: str) -> bool:
    """Return whether an episode of a task can start from the last scene of the previous one."""
    return TASKS[task].continues is not Task.continues


def play_expert(env: BulletArmEnv, episodes: int, *, noise: float = 0.0) -> list[TensorDict]:
    """Return episodes [T] of the expert.

    Args:
        env: with ``expert=True``.
        noise: standard deviation of the Gaussian noise of its actions, as a share of the range of
            each component.
    """
    low, high = env.action_spec.space.low, env.action_spec.space.high
    generator = torch.Generator().manual_seed(0)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict[keys.EXPERT_ACTION]
        if noise:
            action = action + noise * (high - low) * torch.randn(len(low), generator=generator)
        return tensordict.set(keys.ACTION, action.clamp(low, high) if noise else action)

    return [
        env.rollout(MAX_EPISODE_STEPS, policy, auto_cast_to_device=False) for _ in range(episodes)
    ]


def action_at(env: BulletArmEnv, fractions: Sequence[float]) -> torch.Tensor:
    """Return the action at fractions, 0 to 1, of the components' ranges; they are cycled."""
    low, high = env.action_spec.space.low, env.action_spec.space.high
    place = torch.tensor([fractions[i % len(fractions)] for i in range(len(low))]).to(low)
    return low + place * (high - low)


def random_actions(
    env: BulletArmEnv, state: TensorDictBase, rng: np.random.Generator
) -> TensorDictBase:
    """Take random actions and return the entries of the last step, which may be done."""
    for _ in range(RANDOM_STEPS[env.task_class.control]):
        action = action_at(env, rng.uniform(0, 1, 7).astype(np.float32).tolist())
        state = env.step(state.set(keys.ACTION, action))[keys.NEXT]
        if state[keys.DONE]:
            break
    return state
