"""What policies of LeRobot see of a task, in data sets and in environments, without LeRobot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from ba_torchrl.core import keys
from ba_torchrl.core.actions import CloseLoopActions
from ba_torchrl.core.errors import ConfigError, UnknownNameError
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.core.plugins import load_plugins
from ba_torchrl.envs.base import BulletArmEnv
from ba_torchrl.envs.registration import gym_id

STATE, ENVIRONMENT_STATE, IMAGES = (
    "observation.state",
    "observation.environment_state",
    "observation.images.",
)
"""LeRobot's names of what the robot feels, of the poses of objects, and of pictures."""
GYM_NAMES = {STATE: "agent_pos", ENVIRONMENT_STATE: "environment_state"}
"""Names of its vectors in observations of Gymnasium."""
_FELT = (keys.PROPRIO, keys.OBSERVATION, keys.JOINTS)
"""Vectors of the robot, in the order in which they are in `STATE`; `holding` is the last."""
_OBJECT = "object_"
_FRAMES = {"scene": "workspace, rows +x, columns +y", "gripper": "gripper", "camera": "camera"}


class PolicyView:
    """The state, the poses and the pictures that stock policies of LeRobot read.

    Booleans are 0 or 1, depth and heights are pictures of three equal channels, 0 to 255 over the
    range of the image. By default, pictures are all images of one size, the size of the first of
    ``rgb``, ``wrist_rgb`` and the others: LeRobot's Diffusion Policy takes no other.

    Args:
        env: whose observations they are.
        observed: keys of its observations that are there; None for all of them.
        cameras: keys of the images that are pictures; None for the default.

    Raises:
        ConfigError: there is no such image among the observations, or the policies read more than
            is there: a state, and pictures or poses of objects.
    """

    def __init__(
        self,
        env: BulletArmEnv,
        observed: Sequence[str] | None = None,
        cameras: Sequence[str] | None = None,
    ) -> None:
        here = [key for key in env.observation_spec if observed is None or key in observed]
        self.images = {key: env.images[key] for key in self._chosen(env, here, cameras)}
        """Declarations of the images that are pictures, by key."""
        self.names: dict[str, list[str]] = {STATE: [], ENVIRONMENT_STATE: []}
        """Names of the numbers of `STATE` and `ENVIRONMENT_STATE`."""
        self._parts: dict[str, list[tuple[str, list[int]]]] = {STATE: [], ENVIRONMENT_STATE: []}
        units: dict[str, list[str]] = {STATE: [], ENVIRONMENT_STATE: []}
        felt = [key for key in (*_FELT, keys.HOLDING) if key in here]
        for key in felt:
            declared = env.declared.get(key)
            names = declared.names if declared else (key,)
            unit = declared.unit if declared else "1 while an object is held"
            for part in (STATE, ENVIRONMENT_STATE):
                wanted = part == ENVIRONMENT_STATE
                found = [i for i, name in enumerate(names) if name.startswith(_OBJECT) == wanted]
                if not found:
                    continue
                self._parts[part].append((key, found))
                taken = self.names[part]
                taken += [f"{key} {names[i]}" if names[i] in taken else names[i] for i in found]
                units[part].append(unit)
        if felt == [keys.HOLDING]:  # LeRobot drops the axis of a single number
            self.names[STATE].append("empty")
            units[STATE].append("1 while none is")
        self.keys = [*felt, *self.images]
        """Keys of the observations that are read."""
        if not self.names[STATE] or not (self.images or self.names[ENVIRONMENT_STATE]):
            lacking = (
                f"a picture or the poses of objects, beside {', '.join(felt)}"
                if felt
                else f"a state such as {keys.HOLDING}"
            )
            raise ConfigError(
                f"LeRobot's ACT and Diffusion read {lacking}: choose other keys or cameras"
            )
        self.units = {part: "; ".join(found) for part, found in units.items()}
        """Their units, in words."""
        letters = {
            "p": "gripper" if isinstance(env.actions, CloseLoopActions) else "primitive",
            "rz": "yaw",
        }
        self.action_names = [letters.get(name, name) for name in env.actions.components]
        """Names of the action's components."""
        self.action_unit = _action_unit(env)
        """Their units, in words."""

    @staticmethod
    def _chosen(
        env: BulletArmEnv, observed: Sequence[str], cameras: Sequence[str] | None
    ) -> list[str]:
        known = [key for key in env.images if key in observed]
        if cameras is None:
            first = [key for key in (keys.RGB, keys.WRIST_RGB) if key in known]
            sizes = [env.images[key].size for key in (*first, *known)]
            return [key for key in known if env.images[key].size == sizes[0]]
        for name in cameras:
            if name not in known:
                raise UnknownNameError("camera", name, known)
        return list(dict.fromkeys(cameras))

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """LeRobot's declaration of each entry, with units, frames and, of depth, its range."""
        found: dict[str, dict[str, Any]] = {}
        for part, names in self.names.items():
            if names:
                info = {"unit": self.units[part], "frame": "world"}
                found[part] = _vector(names, info)
        for key, image in self.images.items():
            info = {"is_depth_map": False, "frame": _FRAMES[image.frame]}
            if image.dtype != torch.uint8:
                info |= {"unit": "m", "of_0": image.low, "of_255": image.high}
            found[f"{IMAGES}{key}"] = {
                "dtype": "image",
                "shape": (3, image.size, image.size),
                "names": ["channels", "height", "width"],
                "info": info,
            }
        info = {"unit": self.action_unit, "frame": "world"}
        return {**found, keys.ACTION: _vector(self.action_names, info)}

    def read(self, observation: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Return an observation as policies see it.

        Args:
            observation: arrays by key, with any axes before the axes of one step.

        Returns:
            Vectors as float32 and pictures [..., 3, H, W] as uint8, by LeRobot's names.
        """
        out = {
            part: np.concatenate(
                [np.asarray(observation[key], np.float32)[..., found] for key, found in sources],
                axis=-1,
            )
            for part, sources in self._parts.items()
            if sources
        }
        if "empty" in self.names[STATE]:
            out[STATE] = np.concatenate([out[STATE], 1 - out[STATE]], axis=-1)
        for key, image in self.images.items():
            out[f"{IMAGES}{key}"] = _picture(np.asarray(observation[key]), image)
        return out


def _picture(values: np.ndarray, image: ImageSpec) -> np.ndarray:
    """Return an image [..., C, H, W] as three channels of uint8."""
    if values.dtype != np.uint8:
        scaled = (values - image.low) * (255 / (image.high - image.low))
        values = scaled.clip(0, 255).round().astype(np.uint8)
    return values if values.shape[-3] == 3 else np.repeat(values, 3, axis=-3)


def _vector(names: Sequence[str], info: dict[str, Any]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (len(names),), "names": list(names), "info": info}


def _action_unit(env: BulletArmEnv) -> str:
    if isinstance(env.actions, CloseLoopActions):
        return (
            f"gripper: 1 opens, -1 closes; x, y, z: 1 moves by {env.actions.dpos_m:g} m; "
            f"yaw: 1 turns by {env.actions.drot_rad:g} rad"
        )
    return "primitive: 0 picks, 1 places; x, y, z in metres; angles in radians"


class LeRobotEnv(gymnasium.Wrapper):
    """A task whose observations LeRobot's ``preprocess_observation`` takes.

    Pictures are under ``pixels``, channels last; the state is ``agent_pos`` and the poses of
    objects are ``environment_state``. An action beyond its bounds, as networks give, is clipped.
    After an episode its last picture is shown, and nothing is rendered.

    Args:
        task: id of the task.
        config: its parameters.
        cameras: as of `PolicyView`.
        plugins: modules that register the task or its robot.
    """

    def __init__(
        self,
        task: str,
        config: Mapping[str, Any],
        cameras: Sequence[str] | None = None,
        plugins: Sequence[str] = (),
    ) -> None:
        load_plugins(plugins)
        made = gymnasium.make(
            gym_id(task), render_mode="rgb_array", disable_env_checker=True, **config
        )
        super().__init__(made)
        self.task = task
        self._torchrl_env = made.unwrapped.torchrl_env
        self._max_episode_steps = self._torchrl_env.max_steps
        self.view = PolicyView(self._torchrl_env, cameras=cameras)
        self._last_picture: np.ndarray | None = None
        self.observation_space = spaces.Dict(
            self._nested(
                {
                    name: spaces.Box(0, 255, (*feature["shape"][1:], 3), np.uint8)
                    if feature["dtype"] == "image"
                    else spaces.Box(-np.inf, np.inf, feature["shape"], np.float32)
                    for name, feature in self.view.features.items()
                    if name != keys.ACTION
                },
                spaces.Dict,
            )
        )

    @property
    def task_description(self) -> str:
        """The goal of the episode in one sentence; before the first reset, the id of the task."""
        return self._torchrl_env.instruction or self.task

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; the options with which LeRobot marks a rollout have no effect."""
        observation, info = self.env.reset(seed=seed)
        self._last_picture = None
        return self._seen(observation), info

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Execute an action."""
        space = self.action_space
        observation, reward, terminated, truncated, info = self.env.step(
            np.clip(action, space.low, space.high)
        )
        if terminated or truncated:
            self._last_picture = self.env.render()
        return self._seen(observation), reward, terminated, truncated, info

    def render(self) -> np.ndarray:
        """Return a picture of the scene, [height, width, 3] uint8."""
        return self.env.render() if self._last_picture is None else self._last_picture

    def _seen(self, observation: Mapping[str, np.ndarray]) -> dict[str, Any]:
        seen = self.view.read(observation)
        return self._nested(
            {
                name: np.moveaxis(values, 0, -1) if name.startswith(IMAGES) else values
                for name, values in seen.items()
            },
            dict,
        )

    @staticmethod
    def _nested(values: Mapping[str, Any], kind: type) -> dict[str, Any]:
        out = {GYM_NAMES[name]: value for name, value in values.items() if name in GYM_NAMES}
        pixels = {
            name.removeprefix(IMAGES): value
            for name, value in values.items()
            if name.startswith(IMAGES)
        }
        return {**out, "pixels": kind(pixels)} if pixels else out
