"""Networks and policies. They depend on image and action shapes, not on tasks."""

from ba_torchrl.core.evaluation_mode import evaluation_copy
from ba_torchrl.modules.actor_critic.cnn import CNNConfig
from ba_torchrl.modules.actor_critic.critics import ActionValue, StateValue
from ba_torchrl.modules.actor_critic.equivariant import EquivariantConfig, StridedEquivariantConfig
from ba_torchrl.modules.actor_critic.ferm import FERMConfig
from ba_torchrl.modules.actor_critic.gaussian_policy import (
    squashed_gaussian_policy,
    truncated_gaussian_policy,
)
from ba_torchrl.modules.base import NETWORKS, ActorCritic, ActorCriticSpec, NetworkConfig
from ba_torchrl.modules.spatial.asr import ASR, ASRConfig
from ba_torchrl.modules.spatial.base import SpatialQNetwork, SpatialSpec
from ba_torchrl.modules.spatial.equi_asr import EquiASRConfig
from ba_torchrl.modules.spatial.equi_deictic_asr import EquiDeicticASRConfig
from ba_torchrl.modules.spatial.fcn import FCN, EquiFCNConfig, FCNConfig
from ba_torchrl.modules.spatial.policy import (
    SpatialActions,
    SpatialPolicy,
    SpatialValues,
    spatial_policy,
)
from ba_torchrl.modules.spatial.rot_fcn import RotFCN, RotFCNConfig
from ba_torchrl.modules.steerable.layers import SteerableConv2d, SteerableLinear

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
    "spatial_policy",
    "squashed_gaussian_policy",
    "truncated_gaussian_policy",
]
