"""Observations in addition to the images of the control: poses, RGB-D images, point clouds.

Each is a registered class. It is enabled by its name in the environment's parameter `observations`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from ba_torchrl.config import EnvConfig
from ba_torchrl.envs import keys
from ba_torchrl.envs.images import ImageSpec
from ba_torchrl.envs.scene import Scene
from ba_torchrl.errors import ConfigError
from ba_torchrl.registry import Registry
from ba_torchrl.sim.vision.depth import point_cloud
from ba_torchrl.sim.vision.lens import oblique_lens, side_lenses
from ba_torchrl.sim.vision.rgb import RGBD_RANGE_M, render_rgbd
from ba_torchrl.sim.vision.views import finger_boxes
from ba_torchrl.tasks.workspace import Workspace

OBSERVATIONS: Registry[type[Observation]] = Registry("observation", "ba_torchrl.envs")


class Observation(ABC):
    """Entries that are added to every observation.

    Args:
        config: the environment's parameters.
        workspace: bounds of the task.
    """

    parameter: ClassVar[str | None] = None
    """Field of `EnvConfig` that enables the observation, in addition to `observations`."""

    def __init__(self, config: EnvConfig, workspace: Workspace) -> None:
        self.config = config
        self.workspace = workspace

    @classmethod
    def is_enabled(cls, config: EnvConfig) -> bool:
        """Return whether `parameter` enables the observation."""
        return cls.parameter is not None and bool(getattr(config, cls.parameter))

    def images(self) -> dict[str, ImageSpec]:
        """Return the declarations of its images, by key."""
        return {}

    def specs(self, scene: Scene) -> dict[str, TensorSpec]:
        """Return the specifications of its entries other than images, by key."""
        return {}

    @abstractmethod
    def observe(self, scene: Scene) -> dict[str, Tensor]:
        """Return its entries, by key."""


def enabled_observations(config: EnvConfig, workspace: Workspace) -> list[Observation]:
    """Return the observations that a configuration enables.

    Raises:
        ConfigError: a name is unknown.
    """
    for name in config.observations:
        _ = OBSERVATIONS[name]
    return [
        OBSERVATIONS[name](config, workspace)
        for name in OBSERVATIONS
        if name in config.observations or OBSERVATIONS[name].is_enabled(config)
    ]


def merge_entries(parts: list[dict]) -> dict:
    """Return the union of dictionaries with different keys.

    Raises:
        ConfigError: two of them have the same key.
    """
    entries: dict = {}
    for part in parts:
        if repeated := entries.keys() & part.keys():
            raise ConfigError(f"observations: two of them use the key {', '.join(repeated)}")
        entries |= part
    return entries


@OBSERVATIONS.register("vec")
class PoseVector(Observation):
    """The poses of the gripper and the task's landmarks, and the opening of the gripper."""

    @classmethod
    def is_enabled(cls, config: EnvConfig) -> bool:
        """Return whether ``obs_type="vec"``."""
        return config.obs_type == "vec"

    def specs(self, scene: Scene) -> dict[str, TensorSpec]:
        """Return the specification of the vector."""
        length = 1 + 4 * (1 + len(scene.task.landmarks))
        return {keys.OBSERVATION: Unbounded((length,), device="cpu", dtype=torch.float32)}

    def observe(self, scene: Scene) -> dict[str, Tensor]:
        """Return the vector, positions scaled to [-1, 1] by the workspace."""
        axes = (self.workspace.x, self.workspace.y, self.workspace.z)
        values = [2 * scene.robot.opening() - 1]
        for position, yaw in (scene.robot.tool_pose(), *scene.task.landmarks):
            values += [
                (2 * value - low - high) / (high - low)
                for value, (low, high) in zip(position, axes, strict=True)
            ]
            values.append(yaw / math.pi)
        return {keys.OBSERVATION: torch.from_numpy(np.array(values, dtype=np.float32))}


@OBSERVATIONS.register("rgb")
class RgbDepth(Observation):
    """An RGB image of the scene, arm included, and its depth."""

    parameter = "rgb"

    def images(self) -> dict[str, ImageSpec]:
        """Return the declarations of the colour image and of its depth."""
        size, (near, far) = self.config.obs_size, RGBD_RANGE_M
        return {
            keys.RGB: ImageSpec(3, size, 255, storage="exact", frame="camera", dtype=torch.uint8),
            keys.RGB_DEPTH: ImageSpec(1, size, far, near, frame="camera"),
        }

    def observe(self, scene: Scene) -> dict[str, Tensor]:
        """Return the image and its depth, from the camera opposite the robot."""
        lens = oblique_lens(self.workspace.center)
        rgb, depth = render_rgbd(scene.world, lens, self.config.obs_size)
        return {
            keys.RGB: torch.from_numpy(rgb).permute(2, 0, 1),
            keys.RGB_DEPTH: torch.from_numpy(depth.astype(np.float32))[None],
        }


@OBSERVATIONS.register("point_cloud")
class PointCloud(Observation):
    """Points on the surfaces of floor, bodies and fingers, from two cameras at the sides."""

    parameter = "point_cloud"

    def specs(self, scene: Scene) -> dict[str, TensorSpec]:
        """Return the specification of the points."""
        shape = (self.config.point_cloud, 3)
        return {keys.POINT_CLOUD: Unbounded(shape, device="cpu", dtype=torch.float32)}

    def observe(self, scene: Scene) -> dict[str, Tensor]:
        """Return the points, metres."""
        robot, workspace = scene.robot, self.workspace
        fingers = finger_boxes(robot.tool_pose(), robot.finger_span_m * robot.opening() / 2)
        points = point_cloud(
            [scene.camera.mesh, fingers],
            side_lenses(workspace.center, workspace.width),
            self.config.point_cloud,
            (workspace.x, workspace.y, workspace.z),
        )
        return {keys.POINT_CLOUD: torch.from_numpy(points)}
