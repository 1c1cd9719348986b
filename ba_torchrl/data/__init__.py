"""Demonstrations, replay, sampling and augmentation."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ba_torchrl._lazy import lazy_names

if TYPE_CHECKING:
    from ba_torchrl.data.augmentation.rigid import RigidAugmentation
    from ba_torchrl.data.augmentation.so2 import SO2Augmentation
    from ba_torchrl.data.augmentation.views import CenterCrop, RandomViews
    from ba_torchrl.data.dataset import BulletArmExperienceReplay
    from ba_torchrl.data.demo_files import load_demonstrations, save_demonstrations
    from ba_torchrl.data.demos import collect_demonstrations, expert_policy, expert_scores
    from ba_torchrl.data.episodes import collect_episodes, mean_length, success_rate
    from ba_torchrl.data.exchange import export_demonstrations
    from ba_torchrl.data.replay.buffer import FrameReplayBuffer
    from ba_torchrl.data.replay.codecs import ImageCodecs, make_codecs
    from ba_torchrl.data.replay.make import make_replay
    from ba_torchrl.data.replay.prioritized import ExpertPrioritizedSampler
    from ba_torchrl.data.replay.segment_tree import use_python_segment_trees
    from ba_torchrl.data.replay.symmetric import SymmetricSampler
    from ba_torchrl.data.transitions import as_transitions

_MODULES = {
    "BulletArmExperienceReplay": "dataset",
    "CenterCrop": "augmentation.views",
    "ExpertPrioritizedSampler": "replay.prioritized",
    "FrameReplayBuffer": "replay.buffer",
    "ImageCodecs": "replay.codecs",
    "RandomViews": "augmentation.views",
    "RigidAugmentation": "augmentation.rigid",
    "SO2Augmentation": "augmentation.so2",
    "SymmetricSampler": "replay.symmetric",
    "as_transitions": "transitions",
    "collect_demonstrations": "demos",
    "collect_episodes": "episodes",
    "expert_policy": "demos",
    "expert_scores": "demos",
    "export_demonstrations": "exchange",
    "load_demonstrations": "demo_files",
    "make_codecs": "replay.codecs",
    "make_replay": "replay.make",
    "mean_length": "episodes",
    "save_demonstrations": "demo_files",
    "success_rate": "episodes",
    "use_python_segment_trees": "replay.segment_tree",
}
"""Modules of the names, imported at their first use: files and formats need no torch."""

__all__ = [
    "BulletArmExperienceReplay",
    "CenterCrop",
    "ExpertPrioritizedSampler",
    "FrameReplayBuffer",
    "ImageCodecs",
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
    "make_codecs",
    "make_replay",
    "mean_length",
    "save_demonstrations",
    "success_rate",
    "use_python_segment_trees",
]

__getattr__, __dir__ = lazy_names(__name__, _MODULES, __all__)
