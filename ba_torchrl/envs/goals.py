"""Goal-conditioned observations, as Gymnasium-Robotics' ``GoalEnv`` defines them."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from tensordict import TensorDictBase

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.gym import GymEnv, Observation
from ba_torchrl.envs.observations import vector_names
from ba_torchrl.tasks.base import TASKS

_GOALS = ("achieved_goal", "desired_goal")


class GoalEnv(GymEnv):
    """A `GymEnv` with a state in ``observation`` beside ``achieved_goal`` and ``desired_goal``.

    The state is as in `StateEnv`, without the pose of the goal. Rewards and ends are the task's;
    the three ``compute_...`` methods return them for other goals. A simulator fault and an invalid
    scene achieve nothing: both goals then stay as they were in the step before.

    Args:
        task: with `Task.goal_vectors`.
        config: as of `GymEnv`, with ``obs_type="vec"`` and sparse rewards.

    Raises:
        ConfigError: the task has no goals, or the configuration is another one.
    """

    def __init__(self, task: str, *args: Any, **config: Any) -> None:
        vectors = TASKS[task].goal_vectors
        if vectors is None:
            known = (name for name in TASKS if TASKS[name].goal_vectors is not None)
            raise ConfigError(f"{task} has no goals as vectors. Known: {', '.join(known)}")
        for field, needed in (("obs_type", "vec"), ("reward", "sparse")):
            if config.get(field, needed) != needed:
                raise ConfigError(
                    f"{field}={config[field]!r}: ids with goals have {field}={needed!r}; leave it "
                    "out"
                )
        super().__init__(task, *args, **config)
        self._goal = vectors
        poses = self._entries[keys.OBSERVATION]
        goals = tuple(f"object_{place}_" for place in self._goal.landmarks)
        names = vector_names(poses.shape[0] // 4 - 1)
        self._kept = [i for i, name in enumerate(names) if not name.startswith(goals)]
        kept = spaces.Box(poses.low[self._kept], poses.high[self._kept], dtype=poses.dtype)
        self._state_entries = spaces.Dict({**self._entries.spaces, keys.OBSERVATION: kept})
        goal = spaces.Box(-np.inf, np.inf, (len(self._goal.names),), np.float32)
        state = spaces.flatten_space(self._state_entries)
        self.observation_space = spaces.Dict({"observation": state, **dict.fromkeys(_GOALS, goal)})
        self._values: Observation = {}

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> Any:
        """Return 1 where a goal is reached, else 0; goals [n] give a number, [..., n] an array."""
        return self._is_reached(achieved_goal, desired_goal).astype(np.float32)[()]

    def compute_terminated(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any
    ) -> Any:
        """Return whether the goal is reached, which ends an episode."""
        return self._is_reached(achieved_goal, desired_goal)[()]

    def compute_truncated(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any
    ) -> Any:
        """Return False: only the step limit truncates, whatever the goal."""
        return np.zeros_like(self._is_reached(achieved_goal, desired_goal))[()]

    def _is_reached(self, achieved_goal: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
        achieved, desired = np.asarray(achieved_goal), np.asarray(desired_goal)
        for name, values in zip(_GOALS, (achieved, desired), strict=True):
            if values.shape[-1:] != (len(self._goal.names),):
                raise ValueError(
                    f"{name} [..., {len(self._goal.names)}] is needed "
                    f"({', '.join(self._goal.names)}), not {list(values.shape)}"
                )
        return np.asarray(self._goal.is_reached(self.torchrl_env.task_class, achieved, desired))

    def _split(self, state: TensorDictBase) -> tuple[Observation, dict[str, Any]]:
        observation, info = super()._split(state)
        if not state[keys.FAULT] and (state[keys.SUCCESS] or not state[keys.TERMINATED]):
            task = self.torchrl_env.scene.task
            both = (self._goal.achieved(task), self._goal.desired(task))
            values = (np.array(each, dtype=np.float32) for each in both)
            self._values = dict(zip(_GOALS, values, strict=True))
        poses = observation[keys.OBSERVATION][self._kept]
        seen = spaces.flatten(self._state_entries, {**observation, keys.OBSERVATION: poses})
        copies = {name: values.copy() for name, values in self._values.items()}
        return {"observation": seen, **copies}, info
