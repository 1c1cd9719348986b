"""Demonstrations, replay, sampling and augmentation."""

from ba_torchrl.data.augmentation.rigid import RigidAugmentation
from ba_torchrl.data.augmentation.so2 import SO2Augmentation
from ba_torchrl.data.augmentation.views import RandomViews
from ba_torchrl.data.demo_files import load_demonstrations, save_demonstrations
from ba_torchrl.data.demos import collect_demonstrations, expert_policy, expert_scores
from ba_torchrl.data.episodes import collect_episodes, mean_length, success_rate
from ba_torchrl.data.exchange import export_demonstrations
from ba_torchrl.data.replay.buffer import FrameReplayBuffer
from ba_torchrl.data.replay.make import make_replay
from ba_torchrl.data.replay.prioritized import ExpertPrioritizedSampler
from ba_torchrl.data.replay.symmetric import SymmetricSampler
from ba_torchrl.data.transitions import as_transitions

__all__ = [
    "ExpertPrioritizedSampler",
    "FrameReplayBuffer",
    "RandomViews",
    "RigidAugmentation",
    "SO2Augmentation",
    "SymmetricSampler",
    "as_transitions",
    "collect_demonstrations",
    "collect_episodes",
    "expert_policy",
    "expert_scores",
    "export_demonstrations",
    "load_demonstrations",
    "make_replay",
    "mean_length",
    "save_demonstrations",
    "success_rate",
]
