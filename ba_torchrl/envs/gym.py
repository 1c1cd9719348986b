"""The environments in Gymnasium's interface, with NumPy arrays."""

from __future__ import annotations

import copy
import dataclasses
import sys
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded
from typing_extensions import Self

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError, InvalidActionError
from ba_torchrl.envs.factory import make
from ba_torchrl.envs.settings import resolve_env

Observation = dict[str, np.ndarray]

INFO_KEYS = (
    keys.SUCCESS,
    keys.FAULT,
    keys.STEP_COUNT,
    *keys.OF_EXPERT,
    keys.INSTRUCTION,
)
"""Entries that are in ``info`` and not in the observation."""


class GymEnv(gymnasium.Env[Observation, np.ndarray]):
    """A task as a Gymnasium environment with a dictionary of observations.

    ``info`` holds ``success``, ``fault``, ``step_count``, the conditions of success and, with
    ``expert=True``, ``expert_action`` and, of some tasks, ``expert_moves``; ``is_success`` is
    ``success`` under the name that Stable-Baselines3 logs; ``is_out_of_reach`` tells an action that
    the arm cannot execute; ``instruction`` is the goal as a sentence, with
    ``observations=["instruction"]``. Flags are arrays of one bool without axes, which vectors of
    environments stack to arrays of bools.

    Args:
        task: as listed by `ba_torchrl.list_tasks`.
        render_mode: ``rgb_array`` for images from `render`, ``human`` for PyBullet's window.
        register_modules: names of modules outside the package that register the task or its robot.
        config: fields of `ba_torchrl.core.env_config.EnvConfig`.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"], "render_fps": 5}

    def __init__(
        self,
        task: str,
        render_mode: str | None = None,
        register_modules: Sequence[str] = (),
        **config: Any,
    ) -> None:
        if "frameskip" in config:  # TorchRL's GymEnv tries it first and handles this error
            raise TypeError("GymEnv.__init__() got an unexpected keyword argument 'frameskip'")
        if render_mode not in (None, *self.metadata["render_modes"]):
            known = ", ".join(self.metadata["render_modes"])
            raise ConfigError(f"unknown render_mode {render_mode!r}. Known: {known}")
        if render_mode == "human":
            config = {**config, "render": True}
        self.render_mode = render_mode
        self._warned_of_options = False
        self.torchrl_env = make(resolve_env(task, config, modules=register_modules))
        """The same environment for TorchRL; stepping it steps this one."""
        specs = self.torchrl_env.observation_spec
        self._entries = spaces.Dict(
            {key: space_of(spec) for key, spec in specs.items() if key not in INFO_KEYS}
        )
        self.observation_space: spaces.Space = self._entries
        self.action_space = space_of(self.torchrl_env.action_spec)
        self._expert_action: np.ndarray | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """The specification that ``gymnasium.make`` read, with the environment's step limit."""
        return self._spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        if value is not None and value.max_episode_steps is None:
            value = dataclasses.replace(value, max_episode_steps=self._max_episode_steps)
        self._spec = value

    @property
    def _max_episode_steps(self) -> int:
        """The step limit; see `StepLimit`."""
        return self.torchrl_env.max_steps

    @property
    def instruction(self) -> str:
        """The goal of the episode as an English sentence."""
        return self.torchrl_env.instruction

    def expert_action(self) -> np.ndarray:
        """Return the expert's action in the present state, as in ``info``.

        Raises:
            ConfigError: the environment was made without ``expert=True``, or was not reset.
        """
        if self._expert_action is None:
            raise ConfigError(
                "the expert was not asked: give expert=True to gymnasium.make, and reset"
            )
        return self._expert_action.copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode: the first one of ``seed``, or the next one of the current seed."""
        super().reset(seed=seed)
        if options and not self._warned_of_options:
            self._warned_of_options = True
            gymnasium.logger.warn(
                f"reset takes no options, {', '.join(map(repr, options))} has no effect; "
                "parameters are given to gymnasium.make"
            )
        if seed is not None:
            self.torchrl_env.set_seed(seed, static_seed=True)
        return self._split(self.torchrl_env.reset())

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Execute an action of `action_space` (floats of any precision)."""
        following = self.torchrl_env.step(_as_tensordict(action))[keys.NEXT]
        observation, info = self._split(following)
        return (
            observation,
            following[keys.REWARD].item(),
            following[keys.TERMINATED].item(),
            following[keys.TRUNCATED].item(),
            info,
        )

    def render(self) -> np.ndarray | None:
        """Return an image of the scene, [height, width, 3] uint8, in the mode ``rgb_array``."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "nothing is rendered without a render mode: "
                f"gymnasium.make({self.spec.id if self.spec else '...'!r}, render_mode='rgb_array')"
            )
        return self.torchrl_env.render() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the simulator; further calls have no effect."""
        self.torchrl_env.close(raise_if_closed=False)

    def __copy__(self) -> Self:
        return copy.deepcopy(self)  # both would step the same simulator

    def _split(self, state: TensorDictBase) -> tuple[Any, dict[str, Any]]:
        """Return the observation and the info of a state of the TorchRL environment."""
        observation = {
            key: state[key].numpy().astype(space.dtype, copy=False)
            for key, space in self._entries.items()
        }
        values: dict[str, Any] = {
            key: state[key].item() for key in (keys.SUCCESS, keys.FAULT, keys.STEP_COUNT)
        }
        values["is_success"] = values[keys.SUCCESS]
        values |= self.torchrl_env.conditions
        values[keys.IS_OUT_OF_REACH] = self.torchrl_env.is_out_of_reach
        if keys.INSTRUCTION in state:
            values[keys.INSTRUCTION] = self.instruction
        # TorchRL's readers of infos need a `dtype`, which Python's bools lack; vectors of Gymnasium
        # stack arrays and Python's bools, not NumPy's
        arrays = {key: np.asarray(value) for key, value in values.items()}
        info = {key: a if a.dtype == bool else a[()] for key, a in arrays.items()}
        for key in keys.OF_EXPERT:
            if key in state:
                info[key] = state[key].numpy()
        self._expert_action = info.get(keys.EXPERT_ACTION)
        return observation, info


class StateEnv(GymEnv):
    """A `GymEnv` with all observations in one vector, in the order of their keys.

    With poses these are ``holding`` as 0 or 1, then the numbers of ``observation``.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.observation_space = spaces.flatten_space(self._entries)

    def _split(self, state: TensorDictBase) -> tuple[np.ndarray, dict[str, Any]]:
        observation, info = super()._split(state)
        return spaces.flatten(self._entries, observation), info


class StepLimit(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """Has the step limit under the name of Gymnasium's `TimeLimit`, which scripts read."""

    def __init__(self, env: gymnasium.Env) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self)  # so that its spec makes it again
        super().__init__(env)

    @property
    def _max_episode_steps(self) -> int:
        return self.env.get_wrapper_attr("_max_episode_steps")


class ExpertPolicy:
    """The task's expert with the ``predict`` of policies of Stable-Baselines3.

    It asks the environments for the action in their present state and does not read the
    observations, so it must be called once between their steps. Libraries that call policies as
    functions, such as imitation, take it too.

    Args:
        env: made with ``expert=True``: an environment, a vector of Gymnasium, or a ``VecEnv``.

    Examples:
        >>> import gymnasium, ba_torchrl
        >>> from ba_torchrl.envs.gym import ExpertPolicy
        >>> env = gymnasium.make("BulletArm/CloseLoopBlockReaching-State-v0", expert=True)
        >>> expert = ExpertPolicy(env)
        >>> observation, _ = env.reset(seed=0)
        >>> action, _ = expert.predict(observation)
        >>> env.step(action)[0].shape
        (10,)
        >>> env.close()
    """

    def __init__(self, env: Any) -> None:
        if policies := sys.modules.get("stable_baselines3.common.policies"):
            policies.BasePolicy.register(ExpertPolicy)  # DAgger of imitation takes no other class
        self._env = env
        is_vector = isinstance(env, gymnasium.vector.VectorEnv)
        self.observation_space: spaces.Space = (
            env.single_observation_space if is_vector else env.observation_space
        )
        self.action_space: spaces.Space = env.single_action_space if is_vector else env.action_space

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Return the expert's action, [A] or in a vector [environments, A], and ``state``.

        Args:
            observation: one, or a batch with one for each environment; its values are not read.
            state: returned as it is.
            episode_start: not read.
            deterministic: not read.
        """
        name = GymEnv.expert_action.__name__
        if hasattr(self._env, "env_method"):
            return np.stack(self._env.env_method(name)), state
        if isinstance(self._env, gymnasium.vector.VectorEnv):
            return np.stack(self._env.call(name)), state
        action = self._env.get_wrapper_attr(name)()
        space = self.observation_space
        while isinstance(space, spaces.Dict):
            key, space = next(iter(space.items()))
            observation = observation[key]
        return (action[None] if np.ndim(observation) > len(space.shape) else action), state

    __call__ = predict


def space_of(spec: TensorSpec) -> spaces.Space:
    """Return the Gymnasium space of a TorchRL spec, with the same shape; flags are 0 or 1."""
    if isinstance(spec, Composite):
        return spaces.Dict({key: space_of(part) for key, part in spec.items()})
    if isinstance(spec, Binary):  # normalisers and several learners take no MultiBinary
        return spaces.Box(0, 1, tuple(spec.shape), np.float32)
    if isinstance(spec, Bounded):
        return spaces.Box(spec.low.numpy(), spec.high.numpy(), dtype=_numpy_dtype(spec))
    if isinstance(spec, Unbounded):
        return spaces.Box(-np.inf, np.inf, tuple(spec.shape), dtype=_numpy_dtype(spec))
    raise TypeError(f"no Gymnasium space stands for {spec}")


def _numpy_dtype(spec: TensorSpec) -> np.dtype:
    return torch.empty(0, device="cpu", dtype=spec.dtype).numpy().dtype


def _as_tensordict(action: Any) -> TensorDict:
    array = np.asarray(action)
    if array.dtype.kind != "f":
        raise InvalidActionError(f"actions are floating-point numbers, got {array.dtype}")
    with np.errstate(over="ignore"):  # becomes infinite, which the environment refuses
        array = array.astype(np.float32)
    return TensorDict({keys.ACTION: torch.from_numpy(array)}, batch_size=[])
