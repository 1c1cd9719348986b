"""An observation: depth seen by a camera at the wrist, which looks along the tool."""

import math

import numpy as np
import torch

from ba_torchrl.core.images import ImageSpec
from ba_torchrl.envs.observations import OBSERVATIONS, Observation
from ba_torchrl.sim.vision.depth import depth_image
from ba_torchrl.sim.vision.lens import Lens

WRIST = "wrist"
FARTHEST_M = 0.5


@OBSERVATIONS.register("mine/wrist_camera")
class WristCamera(Observation):
    """[1, 32, 32] depth in metres from 12 cm above the tool point, 60 degrees wide."""

    def images(self):
        """Return the declaration of the image."""
        return {WRIST: ImageSpec(1, 32, FARTHEST_M, storage="uint8", frame="camera")}

    def observe(self, scene):
        """Return the image; the robot is not in it."""
        x, y, z = scene.robot.tool_pose()[0]
        lens = Lens((x, y, z + 0.12), (x, y, z), math.radians(60))
        depth = depth_image([scene.camera.mesh], lens, 32)
        image = np.minimum(depth, FARTHEST_M).astype(np.float32)
        return {WRIST: torch.from_numpy(image)[None]}
