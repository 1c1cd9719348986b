"""Close-loop control: the gripper moves by small steps, watched by a camera above it."""

from __future__ import annotations

import math

import numpy as np
import torch
from torchrl.data import Bounded

from ba_torchrl.actions import CloseLoopActions
from ba_torchrl.envs import keys
from ba_torchrl.envs.base import CONTROLS, ManipulationEnv
from ba_torchrl.envs.scene import Scene
from ba_torchrl.sim.cameras import paint_square
from ba_torchrl.sim.motion import CloseLoopMotion
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.base import Reach, Task

START_HEIGHT_M = 0.2
FINGER_GLYPH_HALF_M = 5 * 0.3 / 128
HALF_TURN = (-math.pi / 2, math.pi / 2)
"""What `half_rotation` keeps the yaw within; episodes start in its middle."""
DEEPEST_DIP_M = 0.02
"""Goal areas appear in the image as dips of this depth."""


@CONTROLS.register("close_loop")
class CloseLoopEnv(ManipulationEnv):
    """A task under close-loop control (paper section 3.2, appendix A.2, G.2).

    An action moves the tool by at most `dpos` along each axis and turns it by at most `drot`,
    then opens or closes the gripper. The image is orthographic depth below a camera that
    stays above the tool and does not turn with it; the fingers are drawn as squares of zero.
    """

    default_action_sequence = "pxyzr"

    def _configure(self) -> None:
        self.actions = CloseLoopActions(self.action_sequence, self.config.dpos, self.config.drot)

    @property
    def reach(self) -> Reach:
        """What one action covers."""
        turn = self.config.drot if self.actions.has_yaw else 0.0
        return Reach(self.config.dpos, turn, HALF_TURN if self.config.half_rotation else None)

    @property
    def view_width_m(self) -> float:
        """Width of the image."""
        return self.config.view_scale * self.workspace.width

    def _make_motion(self, robot: Robot, task: Task) -> CloseLoopMotion:
        return CloseLoopMotion(robot, teleport=self.config.fast_mode)

    def _make_action_spec(self) -> Bounded:
        return Bounded(-1.0, 1.0, shape=(self.actions.size,), dtype=torch.float32)

    @property
    def _deepest_m(self) -> float:
        return self.workspace.z[1] + self.robot_class.camera_height_m + DEEPEST_DIP_M

    def _image_specs(self) -> dict[str, Bounded]:
        size = self.config.obs_size
        return {
            keys.PIXELS: Bounded(0.0, self._deepest_m, shape=(1, size, size), dtype=torch.float32)
        }

    def _place_robot(self, scene: Scene) -> None:
        x, y = self.workspace.center
        z = min(max(START_HEIGHT_M, self.workspace.z[0]), self.workspace.z[1])
        scene.motion.reset(((x, y, z), 0.0))

    def _act(self, scene: Scene, action: np.ndarray) -> None:
        command = self.actions.decode(action)
        (x, y, z), yaw = scene.robot.tool_pose()
        target = self.workspace.clip((x + command.dx_m, y + command.dy_m, z + command.dz_m))
        yaw += command.dyaw_rad
        if self.config.half_rotation:
            yaw = min(max(yaw, HALF_TURN[0]), HALF_TURN[1])
        scene.motion.move_to(target, yaw)
        scene.motion.grip(command.opening)

    def _images(self, scene: Scene) -> dict[str, np.ndarray]:
        (x, y, z), yaw = scene.robot.tool_pose()
        size = self.config.obs_size
        camera_z = z + scene.robot.camera_height_m
        heights = scene.camera.heightmap((x, y), self.view_width_m, size)
        depth = np.clip(camera_z - heights, 0.0, self._deepest_m)
        pixel = self.view_width_m / size
        apart = scene.robot.finger_span_m * scene.robot.opening() / 2 / pixel
        for side in (-apart, apart):
            center = (size / 2 + side * math.cos(yaw), size / 2 + side * math.sin(yaw))
            paint_square(depth, center, FINGER_GLYPH_HALF_M / pixel, yaw, 0.0)
        return {keys.PIXELS: depth[None]}

    def _expert_action(self, scene: Scene) -> np.ndarray:
        return self.actions.encode(scene.task.expert_command())
