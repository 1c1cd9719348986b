"""Networks and policies. They depend on image and action shapes, not on tasks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ba_torchrl.core.lazy import lazy_names

if TYPE_CHECKING:
    from ba_torchrl.core.evaluation_mode import evaluation_copy
    from ba_torchrl.modules.actor_critic.cnn_config import CNNConfig
    from ba_torchrl.modules.actor_critic.critics import ActionValue, StateValue
    from ba_torchrl.modules.actor_critic.equivariant_config import (
        EquivariantConfig,
        StridedEquivariantConfig,
    )
    from ba_torchrl.modules.actor_critic.ferm_config import FERMConfig
    from ba_torchrl.modules.actor_critic.gaussian_policy import (
        squashed_gaussian_policy,
        truncated_gaussian_policy,
    )
    from ba_torchrl.modules.base import ActorCritic, ActorCriticSpec
    from ba_torchrl.modules.config import NETWORKS, NetworkConfig
    from ba_torchrl.modules.spatial.asr import ASR
    from ba_torchrl.modules.spatial.asr_config import ASRConfig
    from ba_torchrl.modules.spatial.base import SpatialQNetwork, SpatialSpec
    from ba_torchrl.modules.spatial.equi_asr_config import EquiASRConfig
    from ba_torchrl.modules.spatial.equi_deictic_asr_config import EquiDeicticASRConfig
    from ba_torchrl.modules.spatial.fcn import FCN
    from ba_torchrl.modules.spatial.fcn_config import EquiFCNConfig, FCNConfig
    from ba_torchrl.modules.spatial.policy import (
        SpatialActions,
        SpatialPolicy,
        SpatialValues,
        spatial_policy,
    )
    from ba_torchrl.modules.spatial.rot_fcn import RotFCN
    from ba_torchrl.modules.spatial.rot_fcn_config import RotFCNConfig
    from ba_torchrl.modules.steerable.layers import SteerableConv2d, SteerableLinear
    from ba_torchrl.modules.steerable.planar import planar_rotations

_MODULES = {
    "ASR": "spatial.asr",
    "FCN": "spatial.fcn",
    "NETWORKS": "config",
    "ASRConfig": "spatial.asr_config",
    "ActionValue": "actor_critic.critics",
    "ActorCritic": "base",
    "ActorCriticSpec": "base",
    "CNNConfig": "actor_critic.cnn_config",
    "EquiASRConfig": "spatial.equi_asr_config",
    "EquiDeicticASRConfig": "spatial.equi_deictic_asr_config",
    "EquiFCNConfig": "spatial.fcn_config",
    "EquivariantConfig": "actor_critic.equivariant_config",
    "FCNConfig": "spatial.fcn_config",
    "FERMConfig": "actor_critic.ferm_config",
    "NetworkConfig": "config",
    "RotFCN": "spatial.rot_fcn",
    "RotFCNConfig": "spatial.rot_fcn_config",
    "SpatialActions": "spatial.policy",
    "SpatialPolicy": "spatial.policy",
    "SpatialQNetwork": "spatial.base",
    "SpatialSpec": "spatial.base",
    "SpatialValues": "spatial.policy",
    "StateValue": "actor_critic.critics",
    "SteerableConv2d": "steerable.layers",
    "SteerableLinear": "steerable.layers",
    "StridedEquivariantConfig": "actor_critic.equivariant_config",
    "evaluation_copy": ".core.evaluation_mode",
    "planar_rotations": "steerable.planar",
    "spatial_policy": "spatial.policy",
    "squashed_gaussian_policy": "actor_critic.gaussian_policy",
    "truncated_gaussian_policy": "actor_critic.gaussian_policy",
}
"""Modules of the names, imported at their first use: configurations need no torch."""

__all__ = [
    "ASR",
    "FCN",
    "NETWORKS",
    "ASRConfig",
    "ActionValue",
    "ActorCritic",
    "ActorCriticSpec",
    "CNNConfig",
    "EquiASRConfig",
    "EquiDeicticASRConfig",
    "EquiFCNConfig",
    "EquivariantConfig",
    "FCNConfig",
    "FERMConfig",
    "NetworkConfig",
    "RotFCN",
    "RotFCNConfig",
    "SpatialActions",
    "SpatialPolicy",
    "SpatialQNetwork",
    "SpatialSpec",
    "SpatialValues",
    "StateValue",
    "SteerableConv2d",
    "SteerableLinear",
    "StridedEquivariantConfig",
    "evaluation_copy",
    "planar_rotations",
    "spatial_policy",
    "squashed_gaussian_policy",
    "truncated_gaussian_policy",
]

__getattr__, __dir__ = lazy_names(__name__, _MODULES, __all__)
