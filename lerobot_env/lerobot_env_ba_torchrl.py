"""The tasks of BA-TorchRL for LeRobot's commands: ``--env.type=ba_torchrl --env.task=TASK``.

LeRobot imports every installed distribution whose name begins with ``lerobot_env_``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end

from ba_torchrl.envs.lerobot import ENVIRONMENT_STATE, GYM_NAMES, STATE, LeRobotEnv

__path__: list[str] = []
"""Has no modules below it: LeRobot's `--env.discover_packages_path` asks every package for them."""


@EnvConfig.register_subclass("ba_torchrl")
@dataclass
class BulletArmTask(EnvConfig):
    """A task, its parameters, and the images that are pictures for the policy."""

    task: str = "close_loop/block_picking"
    fps: int = 5
    parameters: dict[str, Any] = field(default_factory=dict)
    """Of the environment, those of the demonstrations, such as ``{"dpos": 0.02}``."""
    cameras: list[str] | None = None
    """Keys of the images that are pictures; None for all images of one size."""
    plugins: list[str] = field(default_factory=list)
    """Modules that register the task or its robot."""

    def __post_init__(self) -> None:
        env = LeRobotEnv(self.task, self.parameters, self.cameras, self.plugins)
        kinds = {
            "action": FeatureType.ACTION,
            STATE: FeatureType.STATE,
            ENVIRONMENT_STATE: FeatureType.ENV,
        }
        for name, feature in env.view.features.items():
            shape, kind = feature["shape"], kinds.get(name, FeatureType.VISUAL)
            if kind is FeatureType.VISUAL:
                shape = (*shape[1:], shape[0])
            key = GYM_NAMES.get(name, name)
            self.features[key] = PolicyFeature(type=kind, shape=shape)
            self.features_map[key] = name
        env.close()

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Nothing: `create_envs` makes the environments."""
        return {}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
        """Return a vector of environments; one whose episode has ended waits for the others."""
        arguments = (self.task, self.parameters, self.cameras, self.plugins)
        makers = [freeze_after_episode_end(partial(LeRobotEnv, *arguments))] * n_envs
        if use_async_envs and n_envs > 1:
            vector = gymnasium.vector.AsyncVectorEnv(makers, context="forkserver")
        else:
            vector = gymnasium.vector.SyncVectorEnv(makers)
        return {self.type: {0: vector}}
