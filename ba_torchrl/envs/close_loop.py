"""Close-loop control: displacements of the gripper, observed by a camera above it."""

from __future__ import annotations

import math

import numpy as np
import torch
from torchrl.data import Bounded

from ba_torchrl.core import keys
from ba_torchrl.core.env_config import EnvConfig
from ba_torchrl.core.images import Frame, ImageSpec
from ba_torchrl.envs.base import BulletArmEnv
from ba_torchrl.envs.episode_positions import RecordedPosition
from ba_torchrl.envs.scene import Scene
from ba_torchrl.envs.settings import ResolvedEnv
from ba_torchrl.sim.control.close_loop import CloseLoopController
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.vision.camera import Camera
from ba_torchrl.sim.vision.camera_views import VIEWS, ViewInput, ViewSetup
from ba_torchrl.tasks.base import Task
from ba_torchrl.tasks.workspace import ActionLimits

START_HEIGHT_M = 0.2
FINGERS_SHARE = 0.1
"""More than the share of the fingers, squares of zero, in an image of the default scale."""
HALF_TURN = (-math.pi / 2, math.pi / 2)
"""Range of the yaw with `half_rotation`; episodes start at its centre."""


class CloseLoopEnv(RecordedPosition, BulletArmEnv):
    """A task under close-loop control (paper section 3.2, appendix A.2, G.2).

    An action moves the tool by at most `dpos` along each axis and turns it by at most `drot`,
    then opens or closes the gripper. By default the image is the orthographic depth below a camera
    that moves with the tool and does not rotate with it. The fingers are drawn as squares of zero.
    Other views are in `ba_torchrl.sim.vision.camera_views`.
    """

    def __init__(self, resolved: ResolvedEnv) -> None:
        config, workspace, robot = resolved.config, resolved.workspace, resolved.robot_class
        self._view = VIEWS[config.view_type]
        self._view_setup = ViewSetup(
            center_m=workspace.center,
            z_m=workspace.z,
            workspace_m=workspace.width,
            width_m=config.view_scale * workspace.width,
            pixels=config.obs_size,
            camera_height_m=robot.camera_height_m,
            finger_span_m=robot.finger_span_m,
        )
        super().__init__(resolved)

    @property
    def action_limits(self) -> ActionLimits:
        turn = self.config.drot if self.actions.has_yaw else 0.0
        yaw_range = HALF_TURN if self.config.half_rotation else None
        return ActionLimits(self.config.dpos, turn, yaw_range)

    def _make_controller(self, robot: Robot, task: Task) -> CloseLoopController:
        return CloseLoopController(robot, teleport=self.config.fast_mode)

    @property
    def _required_tool_heights(self) -> tuple[float, ...]:
        return self.workspace.z

    def _make_action_spec(self) -> Bounded:
        return Bounded(-1.0, 1.0, (self.actions.size,), device="cpu", dtype=torch.float32)

    def _declare_images(self) -> dict[str, ImageSpec]:
        low, high = self._view.range_m(self._view_setup)
        channels, size = self._view.channels, self.config.obs_size
        frame: Frame = "scene" if self._view.rotates_with_scene else "camera"
        is_depth = not getattr(self._view, "shows_height", True)  # with zeros at the fingers only
        scale = max(1.0, EnvConfig.model_fields["view_scale"].default / self.config.view_scale)
        zeros = min(1.0, FINGERS_SHARE * scale**2) if is_depth else 1.0
        image = ImageSpec(channels, size, high, low, "uint8", frame, max_zeros=zeros)
        return {keys.DEPTH: image}

    def _place_robot(self, scene: Scene) -> None:
        x, y = self.workspace.center
        z = min(max(START_HEIGHT_M, self.workspace.z[0]), self.workspace.z[1])
        scene.controller.reset(((x, y, z), 0.0))

    def _act(self, scene: Scene, action: np.ndarray) -> None:
        command = self.actions.decode(action)
        (x, y, z), yaw = scene.robot.tool_pose()
        target = self.workspace.clip((x + command.dx_m, y + command.dy_m, z + command.dz_m))
        yaw += command.dyaw_rad
        if self.config.half_rotation:
            yaw = min(max(yaw, HALF_TURN[0]), HALF_TURN[1])
        scene.controller.move_to(target, yaw)
        scene.controller.grip(command.opening)

    def _images(self, scene: Scene) -> dict[str, np.ndarray]:
        return {keys.DEPTH: self._view.image(self._view_input(scene))}

    def _cameras(self, scene: Scene) -> dict[str, Camera]:
        return {keys.DEPTH: self._view.camera(self._view_input(scene))}

    def _view_input(self, scene: Scene) -> ViewInput:
        robot = scene.robot
        return ViewInput(
            self._view_setup, scene.world, scene.camera, robot.tool_pose(), robot.opening()
        )

    def _expert_action(self, scene: Scene) -> np.ndarray:
        return self.actions.encode(scene.task.expert_command())
