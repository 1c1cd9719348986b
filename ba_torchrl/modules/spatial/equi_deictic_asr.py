"""The equivariant network in six degrees of freedom (appendix D.2; "Equivariant Deictic ASR")."""

from __future__ import annotations

from ba_torchrl.core import keys
from ba_torchrl.modules.base import NETWORKS
from ba_torchrl.modules.spatial.asr import ASR
from ba_torchrl.modules.spatial.base import SpatialSpec
from ba_torchrl.modules.spatial.equi_asr import (
    SCENE_COPIES,
    EquiASRConfig,
    SceneVector,
)
from ba_torchrl.modules.spatial.pose_values import FingerSymmetricValues, PoseValues, SceneMapVector
from ba_torchrl.modules.spatial.pose_views import (
    BothFingerOrders,
    PoseGridConfig,
    TiltedView,
    UprightView,
    is_six_dof,
)


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

    swap_fingers: bool = True

    def build(self, spec: SpatialSpec) -> ASR:
        """Return a freshly initialised network for x, y, z, rz, ry and rx."""
        name = "equi_deictic_asr"
        if not is_six_dof(spec):
            raise ValueError(
                f"network {name!r} chooses x, y, z, rz, ry and rx, and the action has "
                f"{', '.join(spec.components)}; use 'equi_asr', or the action_sequence 'pxyzrrr'"
            )
        planar, patch_size = self._planar_layout(name, spec)
        levels = (*planar, *self.pose_levels())
        in_voxels = self.in_voxels(spec.pixel_m)
        positions, yaws = self._pixels_and_yaws(spec, in_voxels, patch_size)
        channels = positions.scene_channels
        grid = self.pose_grid(self.num_rotations, spec.half_rotation)
        views = (
            UprightView(grid, spec.pixel_m, patch_size),
            TiltedView(grid._replace(rx_rad=(0.0,)), spec.pixel_m, patch_size),
            TiltedView(grid, spec.pixel_m, patch_size),
        )
        later = [yaws]
        for view in views:
            scene = (
                SceneMapVector(channels, spec.image_size, self, copies=SCENE_COPIES)
                if self.scene_head == "flatten"
                else SceneVector(channels, spec.image_size, self)
            )
            values = PoseValues(spec, in_voxels, view.channels, 1, patch_size, scene)
            if self.swap_fingers and spec.half_rotation:
                view = BothFingerOrders(view)
                values = FingerSymmetricValues(values, spec.images[keys.IN_HAND])
            later.append((view, values))
        return ASR(positions, later, levels, self.limits)
