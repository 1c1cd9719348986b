"""What open-loop control declares besides its environments."""

from __future__ import annotations

import math

from ba_torchrl.core.actions import OpenLoopActions
from ba_torchrl.core.env_config import EnvConfig
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.settings import CONTROLS, ControlConfig


@CONTROLS.register("open_loop")
class OpenLoopConfig(ControlConfig):
    """Poses of picks and places."""

    env = "ba_torchrl.envs.open_loop:OpenLoopEnv"
    default_action_sequence = "pxyr"
    default_half_rotation = True
    video_fps = 10

    @classmethod
    def make_actions(cls, config: EnvConfig) -> OpenLoopActions:
        """Return the action space; `ConfigError` unless the workspace is square."""
        x, y, _ = config.workspace
        if not math.isclose(x[1] - x[0], y[1] - y[0], rel_tol=1e-6):
            raise ConfigError("workspace: an open-loop task needs a square one, x as wide as y")
        return OpenLoopActions(
            config.action_sequence, config.workspace, half_rotation=config.half_rotation
        )
