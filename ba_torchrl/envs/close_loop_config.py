"""What close-loop control declares besides its environments."""

from __future__ import annotations

from ba_torchrl.core.actions import CloseLoopActions
from ba_torchrl.core.env_config import EnvConfig
from ba_torchrl.envs.settings import CONTROLS, ControlConfig


@CONTROLS.register("close_loop")
class CloseLoopConfig(ControlConfig):
    """Displacements of the gripper."""

    env = "ba_torchrl.envs.close_loop:CloseLoopEnv"
    default_action_sequence = "pxyzr"
    default_half_rotation = False
    video_fps = 5

    @classmethod
    def make_actions(cls, config: EnvConfig) -> CloseLoopActions:
        return CloseLoopActions(config.action_sequence, config.dpos, config.drot)
