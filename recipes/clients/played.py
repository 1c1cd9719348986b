"""Success of a policy of any library in the first test episodes of a Gymnasium id."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

import ba_torchrl  # noqa: F401 -- registers the ids
from ba_torchrl.core.config import FIRST_TEST_SEED


def played(
    act: Callable[[Any], Any],
    env_id: str,
    episodes: int = 50,
    reset: Callable[[], None] = lambda: None,
    **config: Any,
) -> None:
    """Play the episodes and print the rate of success and the minutes of one core until now.

    Args:
        act: from an observation to an action; both are NumPy arrays or dictionaries of them.
        env_id: of the environment.
        episodes: how many.
        reset: called before each episode.
        config: of the environment.
    """
    env = gymnasium.make(env_id, **config)
    minutes, successes = time.process_time() / 60, 0
    for episode in range(episodes):
        observation, info = env.reset(seed=FIRST_TEST_SEED + episode)
        reset()
        is_over = False
        while not is_over:
            action = np.asarray(act(observation), dtype=np.float32)
            space = env.action_space
            action = np.clip(action.reshape(space.shape), space.low, space.high)
            observation, _, terminated, truncated, info = env.step(action)
            is_over = terminated or truncated
        successes += bool(info["success"])
    env.close()
    print(f"success {successes / episodes:.2f} of {episodes}, {minutes:.1f} minutes of one core")
