"""The tasks in LeRobot's EnvHub: push this file as ``env.py`` to a repository of the Hub.

    envs = lerobot.envs.factory.make_env("user/repository", n_envs=2, trust_remote_code=True)

The entries of its observations have the names of the data sets of ``ba-torchrl convert
format=lerobot``, so that a policy that LeRobot trains on these acts in it. The ids of the suite are
the places of the tasks in `TASKS`. Needs `ba_torchrl` where it runs.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from ba_torchrl.demonstrations.formats.base import FORMATS, Entry
from ba_torchrl.envs.gym import GymEnv

TASKS = ("close_loop/block_picking", "close_loop/block_stacking")
"""Edit: tasks of the suite."""
ENV: dict[str, Any] = {}
"""Edit: their parameters, those of the demonstrations, such as ``{"obs_size": 64}``."""

_PREFIX = "observation."
"""LeRobot puts it before the names that it does not know."""


class LeRobotEnv(gymnasium.Wrapper):
    """A task whose observations LeRobot's ``preprocess_observation`` takes.

    Colours are under ``pixels``, channels last; the state is ``agent_pos``; other entries, depth in
    metres among them, are floats under the ends of their names in LeRobot's data sets.
    """

    def __init__(self, task: str, config: dict[str, Any]) -> None:
        super().__init__(GymEnv(task, render_mode="rgb_array", **config))
        self.task = task
        self._max_episode_steps = self.env.torchrl_env.config.max_steps
        found = self.env.observation_space
        entries = {
            key: Entry(name=key, role="observation", dtype=str(space.dtype), shape=space.shape)
            for key, space in found.items()
        }
        self._names = FORMATS["lerobot"].names(entries)
        self.observation_space = self._renamed(
            {
                key: spaces.Box(0, 255, (*space.shape[1:], 3), np.uint8)
                if _is_colour(space)
                else _as_floats(space)
                for key, space in found.items()
            },
            spaces.Dict,
        )

    @property
    def task_description(self) -> str:
        """The goal of the episode in one sentence; before the first reset, the id of the task."""
        return self.env.torchrl_env.instruction or self.task

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; the options with which LeRobot marks a rollout have no effect."""
        observation, info = self.env.reset(seed=seed)
        return self._converted(observation), info

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Execute an action within its bounds, which the outputs of policies exceed."""
        space = self.action_space
        observation, *results = self.env.step(np.clip(action, space.low, space.high))
        return self._converted(observation), *results

    def _converted(self, observation: dict[str, np.ndarray]) -> dict[str, Any]:
        found = self.env.observation_space
        return self._renamed(
            {
                key: np.moveaxis(values, 0, -1)
                if _is_colour(found[key])
                else values.astype(np.float32)
                for key, values in observation.items()
            },
            dict,
        )

    def _renamed(self, values: dict[str, Any], kind: type) -> Any:
        out, colours = {}, {}
        for key, value in values.items():
            name = self._names[key].removeprefix(_PREFIX)
            if _is_colour(self.env.observation_space[key]):
                colours[name.removeprefix("images.")] = value
            else:
                out["agent_pos" if name == "state" else name] = value
        return kind({**out, "pixels": kind(colours)} if colours else out)


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None
) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
    """Return a vector of environments for each task, as LeRobot's EnvHub asks.

    Args:
        n_envs: environments of a vector.
        use_async_envs: one process per environment.
        cfg: LeRobot's configuration; the task that it names is the only one.

    Raises:
        ValueError: ``n_envs`` is less than 1.
    """
    if n_envs < 1:
        raise ValueError(f"n_envs must be at least 1, not {n_envs}")
    task = getattr(cfg, "task", None)
    vector = gymnasium.vector.AsyncVectorEnv if use_async_envs else gymnasium.vector.SyncVectorEnv
    return {
        "ba_torchrl": {
            number: vector([partial(LeRobotEnv, name, ENV)] * n_envs)
            for number, name in enumerate([task] if task else TASKS)
        }
    }


def _is_colour(space: spaces.Space) -> bool:
    return space.dtype == np.uint8 and space.shape[0] == 3


def _as_floats(space: spaces.Space) -> spaces.Box:
    if isinstance(space, spaces.Box):
        low, high = space.low.astype(np.float32), space.high.astype(np.float32)
        return spaces.Box(low, high, dtype=np.float32)
    return spaces.Box(0, 1, space.shape, np.float32)  # flags
