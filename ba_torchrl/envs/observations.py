"""Observations beside the image that a policy acts on: poses, pictures and points."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from ba_torchrl.config import EnvConfig
from ba_torchrl.envs import keys
from ba_torchrl.envs.images import ImageSpec
from ba_torchrl.envs.scene import Scene
from ba_torchrl.sim.vision.depth import point_cloud
from ba_torchrl.sim.vision.lens import oblique_lens, side_lenses
from ba_torchrl.sim.vision.rgb import RGBD_RANGE_M, render_rgbd
from ba_torchrl.sim.vision.views import finger_posts
from ba_torchrl.tasks.workspace import Workspace


class ExtraObservations:
    """What `rgb`, `point_cloud` and ``obs_type="vec"`` add.

    Args:
        config: the environment's parameters.
        workspace: where the task takes place.
    """

    def __init__(self, config: EnvConfig, workspace: Workspace) -> None:
        self.config = config
        self.workspace = workspace

    def images(self) -> dict[str, ImageSpec]:
        """Return the declarations of the images that are added, by key."""
        if not self.config.rgb:
            return {}
        size, (near, far) = self.config.obs_size, RGBD_RANGE_M
        return {
            keys.RGB: ImageSpec(3, size, 255, storage="exact", frame="camera", dtype=torch.uint8),
            keys.RGB_DEPTH: ImageSpec(1, size, far, near, frame="camera"),
        }

    def specs(self, scene: Scene) -> dict[str, TensorSpec]:
        """Return the specifications of what is added besides images, by key."""
        config, specs = self.config, {}
        if config.obs_type == "vec":
            length = 1 + 4 * (1 + len(scene.task.landmarks))
            specs[keys.OBSERVATION] = Unbounded(shape=(length,), dtype=torch.float32)
        if config.point_cloud:
            specs[keys.POINT_CLOUD] = Unbounded(shape=(config.point_cloud, 3), dtype=torch.float32)
        return specs

    def observe(self, scene: Scene) -> dict[str, Tensor]:
        """Return what is added, by key."""
        config, out = self.config, {}
        if config.obs_type == "vec":
            out[keys.OBSERVATION] = torch.from_numpy(self._vector(scene))
        if config.rgb:
            rgb, depth = render_rgbd(
                scene.world, oblique_lens(self.workspace.center), config.obs_size
            )
            out[keys.RGB] = torch.from_numpy(rgb).permute(2, 0, 1)
            out[keys.RGB_DEPTH] = torch.from_numpy(depth.astype(np.float32))[None]
        if config.point_cloud:
            out[keys.POINT_CLOUD] = torch.from_numpy(self._points(scene))
        return out

    def _vector(self, scene: Scene) -> np.ndarray:
        """Return the poses of gripper and landmarks, scaled to [-1, 1] by the workspace."""
        axes = (self.workspace.x, self.workspace.y, self.workspace.z)
        values = [2 * scene.robot.opening() - 1]
        for position, yaw in (scene.robot.tool_pose(), *scene.task.landmarks):
            values += [
                (2 * value - low - high) / (high - low)
                for value, (low, high) in zip(position, axes, strict=True)
            ]
            values.append(yaw / math.pi)
        return np.array(values, dtype=np.float32)

    def _points(self, scene: Scene) -> np.ndarray:
        """Return points of floor, bodies and fingers that two cameras at the sides see."""
        robot, workspace = scene.robot, self.workspace
        fingers = finger_posts(robot.tool_pose(), robot.finger_span_m * robot.opening() / 2)
        return point_cloud(
            [scene.camera.surface, fingers],
            side_lenses(workspace.center, workspace.width),
            self.config.point_cloud,
            (workspace.x, workspace.y, workspace.z),
        )
