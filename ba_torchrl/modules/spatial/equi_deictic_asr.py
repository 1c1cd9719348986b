"""The equivariant network in six degrees of freedom (appendix D.2; "Equivariant Deictic ASR")."""

from __future__ import annotations

from ba_torchrl.core import keys
from ba_torchrl.modules.spatial.asr import ASR, planar_layout
from ba_torchrl.modules.spatial.base import SpatialSpec
from ba_torchrl.modules.spatial.equi_asr import SCENE_COPIES, SceneVector, pixels_and_yaws
from ba_torchrl.modules.spatial.equi_deictic_asr_config import EquiDeicticASRConfig
from ba_torchrl.modules.spatial.pose_values import FingerSymmetricValues, PoseValues, SceneMapVector
from ba_torchrl.modules.spatial.pose_views import (
    BothFingerOrders,
    TiltedView,
    UprightView,
    is_six_dof,
    pose_grid,
    pose_levels,
)


def build_equi_deictic_asr(config: EquiDeicticASRConfig, spec: SpatialSpec) -> ASR:
    """Return a freshly initialised network for x, y, z, rz, ry and rx."""
    name = "equi_deictic_asr"
    if not is_six_dof(spec):
        raise ValueError(
            f"network {name!r} chooses x, y, z, rz, ry and rx, and the action has "
            f"{', '.join(spec.components)}; use 'equi_asr', or the action_sequence 'pxyzrrr'"
        )
    planar, patch_size = planar_layout(config, name, spec)
    levels = (*planar, *pose_levels(config))
    in_voxels = config.in_voxels(spec.pixel_m)
    positions, yaws = pixels_and_yaws(config, spec, in_voxels, patch_size)
    channels = positions.scene_channels
    grid = pose_grid(config, config.num_rotations, spec.half_rotation)
    views = (
        UprightView(grid, spec.pixel_m, patch_size),
        TiltedView(grid._replace(rx_rad=(0.0,)), spec.pixel_m, patch_size),
        TiltedView(grid, spec.pixel_m, patch_size),
    )
    later = [yaws]
    for view in views:
        scene = (
            SceneMapVector(channels, spec.image_size, config, copies=SCENE_COPIES)
            if config.scene_head == "flatten"
            else SceneVector(channels, spec.image_size, config)
        )
        values = PoseValues(spec, in_voxels, view.channels, 1, patch_size, scene)
        if config.swap_fingers and spec.half_rotation:
            view = BothFingerOrders(view)
            values = FingerSymmetricValues(values, spec.images[keys.IN_HAND])
        later.append((view, values))
    return ASR(positions, later, levels, config.limits)
