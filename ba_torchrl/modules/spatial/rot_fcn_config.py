"""Hyper-parameters of the FCN that evaluates rotated images."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from ba_torchrl.modules.config import NETWORKS
from ba_torchrl.modules.spatial.spatial_config import SpatialImageConfig


@NETWORKS.register("rot_fcn")
class RotFCNConfig(SpatialImageConfig):
    """Hyper-parameters of the Rot FCN.

    Args:
        num_rotations: yaws, evenly spaced; the default is from the reference implementation.
    """

    builder: ClassVar[str] = "ba_torchrl.modules.spatial.rot_fcn:build_rot_fcn"

    num_rotations: int = Field(default=16, ge=2, le=360)
