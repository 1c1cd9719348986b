"""Hyper-parameters of the equivariant network in six degrees of freedom."""

from __future__ import annotations

from typing import ClassVar

from ba_torchrl.modules.config import NETWORKS
from ba_torchrl.modules.spatial.equi_asr_config import EquiASRConfig
from ba_torchrl.modules.spatial.pose_grid_config import PoseGridConfig


@NETWORKS.register("equi_deictic_asr")
class EquiDeicticASRConfig(EquiASRConfig, PoseGridConfig):
    """Hyper-parameters of the network that sees the scene from every candidate pose.

    Pixels and yaws are chosen by the equivariant networks of 'equi_asr'. Each z, ry and rx is
    evaluated on the projections of the scene at the pose with that value, by shared weights. If the
    features of the scene are pooled, these values do not change when scene and yaw rotate together.
    With yaws of half a turn, a rotation that wraps the yaw swaps the fingers: the same
    pose has the opposite tilts, and the other end of what is held points forward. The values are
    therefore the mean over both orders of the fingers, each with its projections and the in-hand
    image turned by half a turn; this doubles the cost of these levels. With the scene head
    "flatten", z and the tilts see a convolution of the scene feature map.

    Args:
        swap_fingers: take the mean over both orders of the fingers where yaws span half a turn; the
            paper describes one order.
    """

    builder: ClassVar[str] = "ba_torchrl.modules.spatial.equi_deictic_asr:build_equi_deictic_asr"

    swap_fingers: bool = True
