"""Observations in addition to the images of the control: poses, RGB-D images, instructions.

Each is a registered class. It is enabled by its name in the environment's parameter `observations`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
import torch
from tensordict import NonTensorData
from torch import Tensor
from torchrl.data import Bounded, NonTensor, TensorSpec

from ba_torchrl.core import keys
from ba_torchrl.core.env_config import EnvConfig
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.core.registry import Registry
from ba_torchrl.core.vectors import VectorSpec
from ba_torchrl.envs.scene import Scene
from ba_torchrl.sim.vision.camera import Camera, perspective
from ba_torchrl.sim.vision.camera_views import finger_boxes
from ba_torchrl.sim.vision.depth import point_cloud
from ba_torchrl.sim.vision.lens import oblique_lens, side_lenses, wrist_lens
from ba_torchrl.sim.vision.rgb import RGBD_RANGE_M, render_owners, render_rgbd
from ba_torchrl.tasks.workspace import Workspace

WRIST_RANGE_M = (0.02, 2.0)
"""Near and far plane of the wrist camera."""
_REACH_M = 2.0
"""No arm's gripper is farther from its base."""
_FAR = 100.0
"""Larger than any position that is scaled by the workspace, even a removed object's."""
_MAX_TILT_RAD = math.pi / 8
"""More than the tilt of a gripper between two actions, which point it down; in open loop it is
tilted during actions only."""


class Observation(ABC):
    """Base of all optional entries, which are added to every observation."""

    parameter: ClassVar[str | None] = None
    """Field of `EnvConfig` that enables the observation, in addition to `observations`."""
    uses_camera: ClassVar[bool] = True
    """Whether it depends on `camera_size`."""

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

    def cameras(self, scene: Scene) -> dict[str, Camera]:
        """Return the geometry of its images in the present scene, by key."""
        return {}

    def vectors(self, scene: Scene) -> dict[str, VectorSpec]:
        """Return the declarations of its vectors and points, by key."""
        return {}

    def specs(self, scene: Scene) -> dict[str, TensorSpec]:
        """Return the specifications of its entries other than images, by key."""
        return {key: each.to_tensor_spec() for key, each in self.vectors(scene).items()}

    @abstractmethod
    def observe(self, scene: Scene) -> dict[str, Tensor | NonTensorData]:
        """Return its entries, by key."""


OBSERVATIONS: Registry[type[Observation]] = Registry("observation", "ba_torchrl.envs", Observation)


def enabled_observations(config: EnvConfig, workspace: Workspace) -> list[Observation]:
    """Return the observations that a configuration enables."""
    return [enabled(config, workspace) for enabled in enabled_classes(config)]


def enabled_classes(config: EnvConfig) -> list[type[Observation]]:
    """Return the classes of the observations that a configuration enables."""
    for name in config.observations:
        _ = OBSERVATIONS[name]
    return [
        OBSERVATIONS[name]
        for name in OBSERVATIONS
        if name in config.observations or OBSERVATIONS[name].is_enabled(config)
    ]


def merge_entries(parts: list[dict]) -> dict:
    """Return the union of dictionaries with different keys."""
    entries: dict = {}
    for part in parts:
        if repeated := entries.keys() & part.keys():
            raise ConfigError(f"observations: two of them use the key {', '.join(repeated)}")
        entries |= part
    return entries


def vector_names(objects: int = 1) -> list[str]:
    """Return the names of the numbers of ``obs_type="vec"``, in order.

    ``opening`` of the gripper is from -1 (closed) to 1; ``x``, ``y`` and ``z`` are from -1 to 1
    within the workspace; ``yaw`` is in radians over pi.

    Args:
        objects: number of the task's `landmarks`: its objects, and goals or containers.
    """
    owners = ["tool", *(f"object_{number}" for number in range(objects))]
    return ["opening", *(f"{owner}_{axis}" for owner in owners for axis in ("x", "y", "z", "yaw"))]


@OBSERVATIONS.register("vec")
class PoseVector(Observation):
    """The poses of the gripper and the task's landmarks, and the opening of the gripper."""

    uses_camera = False

    @classmethod
    def is_enabled(cls, config: EnvConfig) -> bool:
        """Return whether ``obs_type="vec"``."""
        return config.obs_type == "vec"

    def vectors(self, scene: Scene) -> dict[str, VectorSpec]:
        names = vector_names(len(scene.task.landmarks))
        kinds = [name.rpartition("_")[2] for name in names]
        high = tuple({"opening": 1.0, "yaw": 2.0}.get(kind, _FAR) for kind in kinds)
        low = tuple(-value for value in high)
        unit = "positions scaled to [-1, 1] by the workspace, yaws over pi"
        return {keys.OBSERVATION: VectorSpec(tuple(names), unit, low, high)}

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
        size, (near, far) = self.config.camera_pixels, RGBD_RANGE_M
        return {
            keys.RGB: ImageSpec(3, size, 255, storage="exact", frame="camera", dtype=torch.uint8),
            keys.RGB_DEPTH: ImageSpec(1, size, far, near, frame="camera"),
        }

    def cameras(self, scene: Scene) -> dict[str, Camera]:
        """Return the geometry of the camera opposite the robot."""
        lens, pixels = oblique_lens(self.workspace.center), self.config.camera_pixels
        return {
            keys.RGB: perspective(lens, pixels, RGBD_RANGE_M, "color"),
            keys.RGB_DEPTH: perspective(lens, pixels, RGBD_RANGE_M),
        }

    def observe(self, scene: Scene) -> dict[str, Tensor]:
        """Return the image and its depth, from the camera opposite the robot."""
        lens = oblique_lens(self.workspace.center)
        rgb, depth = render_rgbd(scene.world, lens, self.config.camera_pixels)
        return {
            keys.RGB: torch.from_numpy(rgb).permute(2, 0, 1),
            keys.RGB_DEPTH: torch.from_numpy(depth.astype(np.float32))[None],
        }


@OBSERVATIONS.register("point_cloud")
class PointCloud(Observation):
    """Points on the surfaces of floor, bodies and fingers, from two cameras at the sides."""

    uses_camera = False

    parameter = "point_cloud"

    def vectors(self, scene: Scene) -> dict[str, VectorSpec]:
        box = (self.workspace.x, self.workspace.y, self.workspace.z)
        low, high = (tuple(ends[i] + side for ends in box) for i, side in ((0, -1.0), (1, 1.0)))
        points = VectorSpec(("x", "y", "z"), "metres", low, high, rows=self.config.point_cloud)
        return {keys.POINT_CLOUD: points}

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


@OBSERVATIONS.register("proprio")
class Proprioception(Observation):
    """Pose of the tool and opening of the gripper."""

    uses_camera = False

    def vectors(self, scene: Scene) -> dict[str, VectorSpec]:
        pose = VectorSpec(
            ("x", "y", "z", "qx", "qy", "qz", "qw", "opening"),
            "metres, a unit quaternion, and 0 (closed) to 1 (open)",
            (-_REACH_M,) * 3 + (-1.0,) * 4 + (0.0,),
            (_REACH_M,) * 3 + (1.0,) * 4 + (1.0,),
            quaternion=3,
            max_tilt_rad=_MAX_TILT_RAD,
        )
        return {keys.PROPRIO: pose}

    def observe(self, scene: Scene) -> dict[str, Tensor]:
        """Return the vector.

        A quaternion and its negative are the same rotation. With x >= 0, a gripper that points down
        has no change of sign between the yaws -pi and pi; its w is zero.
        """
        robot = scene.robot
        position, orientation = robot.tool_frame()
        sign = 1.0 if orientation[0] >= 0 else -1.0
        values = [*position, *(sign * value for value in orientation), robot.opening()]
        return {keys.PROPRIO: torch.tensor(values, device="cpu", dtype=torch.float32)}


@OBSERVATIONS.register("joints")
class Joints(Observation):
    """Angles of the arm's joints."""

    uses_camera = False

    def vectors(self, scene: Scene) -> dict[str, VectorSpec]:
        count = len(scene.robot.arm_joints)
        names = tuple(f"joint {number}" for number in range(count))
        turn = (2 * math.pi,) * count
        return {keys.JOINTS: VectorSpec(names, "radians", tuple(-x for x in turn), turn)}

    def observe(self, scene: Scene) -> dict[str, Tensor]:
        """Return the measured angles, radians."""
        angles = scene.robot.measured_joints()
        return {keys.JOINTS: torch.tensor(angles, device="cpu", dtype=torch.float32)}


@OBSERVATIONS.register("wrist_rgb")
class WristRgb(Observation):
    """An RGB image of a camera on the gripper: the fingertips and what is between them."""

    def images(self) -> dict[str, ImageSpec]:
        size = self.config.camera_pixels
        spec = ImageSpec(3, size, 255, storage="exact", frame="camera", dtype=torch.uint8)
        return {keys.WRIST_RGB: spec}

    def cameras(self, scene: Scene) -> dict[str, Camera]:
        """Return the geometry of the camera on the gripper."""
        lens = wrist_lens(scene.robot.tool_frame())
        return {
            keys.WRIST_RGB: perspective(lens, self.config.camera_pixels, WRIST_RANGE_M, "color")
        }

    def observe(self, scene: Scene) -> dict[str, Tensor]:
        lens = wrist_lens(scene.robot.tool_frame())
        rgb, _ = render_rgbd(scene.world, lens, self.config.camera_pixels, WRIST_RANGE_M)
        return {keys.WRIST_RGB: torch.from_numpy(rgb).permute(2, 0, 1)}


@OBSERVATIONS.register("segmentation")
class Segmentation(Observation):
    """The body in each pixel of the camera of `rgb`."""

    def specs(self, scene: Scene) -> dict[str, TensorSpec]:
        size, last = self.config.camera_pixels, len(segmentation_names(scene)) - 1
        spec = Bounded(0, last, (1, size, size), device="cpu", dtype=torch.int32)
        return {keys.SEGMENTATION: spec}

    def cameras(self, scene: Scene) -> dict[str, Camera]:
        """Return the geometry of the camera opposite the robot."""
        lens = oblique_lens(self.workspace.center)
        camera = perspective(lens, self.config.camera_pixels, RGBD_RANGE_M, "color")
        return {keys.SEGMENTATION: camera}

    def observe(self, scene: Scene) -> dict[str, Tensor]:
        """Return the indices of the bodies in `segmentation_names`."""
        lens = oblique_lens(self.workspace.center)
        bodies, links = render_owners(scene.world, lens, self.config.camera_pixels)
        indices = np.zeros(bodies.shape, dtype=np.int32)
        indices[bodies == scene.robot.id] = 1
        for index, body in enumerate(scene.world.bodies, start=2):
            indices[(bodies == body.id) & np.isin(links, body.links)] = index
        return {keys.SEGMENTATION: torch.from_numpy(indices)[None]}


def segmentation_names(scene: Scene) -> tuple[str, ...]:
    """Return the names of the indices of ``segmentation``; objects follow background and robot."""
    return ("background", "robot", *(body.name for body in scene.world.bodies))


@OBSERVATIONS.register("instruction")
class Instruction(Observation):
    """The goal of the episode as an English sentence."""

    uses_camera = False

    def specs(self, scene: Scene) -> dict[str, TensorSpec]:
        return {keys.INSTRUCTION: NonTensor((), example_data="", device="cpu")}

    def observe(self, scene: Scene) -> dict[str, NonTensorData]:
        return {keys.INSTRUCTION: NonTensorData(scene.task.instruction())}
