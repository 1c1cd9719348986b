"""Hyper-parameters of the networks that choose a pixel, then one component after the other."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from ba_torchrl.core.config import MAX_PIXELS
from ba_torchrl.modules.config import NETWORKS
from ba_torchrl.modules.spatial.pose_grid_config import PoseGridConfig
from ba_torchrl.modules.spatial.spatial_config import SpatialImageConfig


class ASRNetworkConfig(SpatialImageConfig):
    """Hyper-parameters of every ASR network.

    Args:
        num_rotations: yaws, evenly spaced; the default is from the reference implementation.
        patch_size: rows and columns of the patch around a pixel that the later levels see; None for
            the size of the in-hand image (in the paper 24, and 40 on bumps). If the two sizes
            differ, the in-hand image is cropped or zero-padded to the patch size about its centre.
    """

    num_rotations: int = Field(default=16, ge=2, le=360)
    patch_size: int | None = Field(default=None, ge=1, le=MAX_PIXELS)


@NETWORKS.register("asr")
class ASRConfig(ASRNetworkConfig, PoseGridConfig):
    """Hyper-parameters of the plain network that chooses one component after the other.

    The hyper-parameters of z and the tilts apply to actions in six degrees of freedom only.
    """

    builder: ClassVar[str] = "ba_torchrl.modules.spatial.asr:build_asr"
