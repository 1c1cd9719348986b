"""Networks and policies. They depend on image and action shapes, not on tasks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ba_torchrl.core.lazy import lazy_names

if TYPE_CHECKING:
    from ba_torchrl.core.evaluation_mode import evaluation_copy as evaluation_copy
    from ba_torchrl.modules.actor_critic.cnn_config import CNNConfig as CNNConfig
    from ba_torchrl.modules.actor_critic.critics import (
        ActionValue as ActionValue,
        StateValue as StateValue,
    )
    from ba_torchrl.modules.actor_critic.equivariant_config import (
        EquivariantConfig as EquivariantConfig,
        StridedEquivariantConfig as StridedEquivariantConfig,
    )
    from ba_torchrl.modules.actor_critic.ferm_config import FERMConfig as FERMConfig
    from ba_torchrl.modules.actor_critic.gaussian_policy import (
        squashed_gaussian_policy as squashed_gaussian_policy,
        truncated_gaussian_policy as truncated_gaussian_policy,
    )
    from ba_torchrl.modules.base import (
        ActorCritic as ActorCritic,
        ActorCriticSpec as ActorCriticSpec,
    )
    from ba_torchrl.modules.config import NETWORKS as NETWORKS, NetworkConfig as NetworkConfig
    from ba_torchrl.modules.spatial.asr import ASR as ASR
    from ba_torchrl.modules.spatial.asr_config import ASRConfig as ASRConfig
    from ba_torchrl.modules.spatial.base import (
        SpatialQNetwork as SpatialQNetwork,
        SpatialSpec as SpatialSpec,
    )
    from ba_torchrl.modules.spatial.equi_asr_config import EquiASRConfig as EquiASRConfig
    from ba_torchrl.modules.spatial.equi_deictic_asr_config import (
        EquiDeicticASRConfig as EquiDeicticASRConfig,
    )
    from ba_torchrl.modules.spatial.fcn import FCN as FCN
    from ba_torchrl.modules.spatial.fcn_config import (
        EquiFCNConfig as EquiFCNConfig,
        FCNConfig as FCNConfig,
    )
    from ba_torchrl.modules.spatial.policy import (
        SpatialActions as SpatialActions,
        SpatialPolicy as SpatialPolicy,
        SpatialValues as SpatialValues,
        spatial_policy as spatial_policy,
    )
    from ba_torchrl.modules.spatial.rot_fcn import RotFCN as RotFCN
    from ba_torchrl.modules.spatial.rot_fcn_config import RotFCNConfig as RotFCNConfig
    from ba_torchrl.modules.steerable.layers import (
        SteerableConv2d as SteerableConv2d,
        SteerableLinear as SteerableLinear,
    )
    from ba_torchrl.modules.steerable.planar import planar_rotations as planar_rotations


__getattr__, __dir__, __all__ = lazy_names(__name__)
