"""Loss modules that follow TorchRL's contract."""

from ba_torchrl.objectives.dqn import LevelDQNLoss, SingleLevelValues
from ba_torchrl.objectives.flow import FlowMatchingLoss
from ba_torchrl.objectives.imitation import BehaviourCloningLoss, LevelCrossEntropyLoss
from ba_torchrl.objectives.networks import with_buffer_updates
from ba_torchrl.objectives.rlpd import RLPDLoss
from ba_torchrl.objectives.sacfd import SACfDLoss

__all__ = [
    "BehaviourCloningLoss",
    "FlowMatchingLoss",
    "LevelCrossEntropyLoss",
    "LevelDQNLoss",
    "RLPDLoss",
    "SACfDLoss",
    "SingleLevelValues",
    "with_buffer_updates",
]
