"""Goal-conditioned observations, as Gymnasium-Robotics' ``GoalEnv`` defines them."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.gym import GymEnv, StateObservation
from ba_torchrl.envs.observations import vector_names
from ba_torchrl.tasks.goals import GOALS

_GOALS = ("achieved_goal", "desired_goal")

GoalDict = dict[str, np.ndarray]


class GoalObservation(gymnasium.Wrapper[GoalDict, np.ndarray, GoalDict, np.ndarray]):
    """A state in ``observation`` beside ``achieved_goal`` and ``desired_goal``.

    The state is that of `StateObservation` without the pose of the goal. Rewards and ends are those
    of the task; the three ``compute_...`` methods return them for other goals. A simulator fault
    and an invalid scene achieve nothing: both goals are then those of the step before.

    Args:
        env: of a task of `ba_torchrl.tasks.goals.GOALS`, with ``obs_type="vec"`` and sparse rewards

    Raises:
        ConfigError: the environment is another one.
    """

    _max_episode_steps = StateObservation._max_episode_steps

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        inner: GymEnv = env.unwrapped
        self._env = inner.torchrl_env
        self._task_class = self._env.task_class
        name, config = self._env.task_id, self._env.config
        if name not in GOALS:
            raise ConfigError(f"{name} has no goals as vectors. Known: {', '.join(GOALS)}")
        for field, needed in (("obs_type", "vec"), ("reward", "sparse")):
            if getattr(config, field) != needed:
                raise ConfigError(
                    f"{field}={getattr(config, field)!r}: ids with goals have "
                    f"{field}={needed!r}; leave it out"
                )
        self._goal = GOALS[name]
        objects = self._env.observation_spec[keys.OBSERVATION].shape[0] // 4 - 1
        goals = tuple(f"object_{place}_" for place in self._goal.landmarks)
        self._kept = [
            i for i, each in enumerate(vector_names(objects)) if not each.startswith(goals)
        ]
        found = env.observation_space
        poses = found[keys.OBSERVATION]
        kept = spaces.Box(poses.low[self._kept], poses.high[self._kept], dtype=poses.dtype)
        self._state_space = spaces.Dict({**found.spaces, keys.OBSERVATION: kept})
        goal = spaces.Box(-np.inf, np.inf, (len(self._goal.names),), np.float32)
        self.observation_space = spaces.Dict(
            {
                "observation": spaces.flatten_space(self._state_space),
                **dict.fromkeys(_GOALS, goal),
            }
        )
        self._values: GoalDict = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[GoalDict, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._measure()
        return self._with_goals(observation), info

    def step(self, action: np.ndarray) -> tuple[GoalDict, float, bool, bool, dict[str, Any]]:
        """Execute an action."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if not info[keys.FAULT] and (info[keys.SUCCESS] or not terminated):
            self._measure()
        return self._with_goals(observation), reward, terminated, truncated, info

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
        return np.asarray(self._goal.is_reached(self._task_class, achieved, desired))

    def _measure(self) -> None:
        task = self._env.scene.task
        both = (self._goal.achieved(task), self._goal.desired(task))
        values = (np.array(each, dtype=np.float32) for each in both)
        self._values = dict(zip(_GOALS, values, strict=True))

    def _with_goals(self, observation: GoalDict) -> GoalDict:
        poses = observation[keys.OBSERVATION][self._kept]
        state = spaces.flatten(self._state_space, {**observation, keys.OBSERVATION: poses})
        copies = {name: values.copy() for name, values in self._values.items()}
        return {"observation": state, **copies}
