"""Replay, sampling and augmentation."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ba_torchrl.core.lazy import lazy_names

if TYPE_CHECKING:
    from ba_torchrl.data.augmentation.rigid import RigidAugmentation
    from ba_torchrl.data.augmentation.so2 import SO2Augmentation, StoredCopies
    from ba_torchrl.data.augmentation.views import CenterCrop, RandomViews
    from ba_torchrl.data.replay.buffer import FrameReplayBuffer
    from ba_torchrl.data.replay.codecs import ImageCodecs, make_codecs
    from ba_torchrl.data.replay.make import make_replay
    from ba_torchrl.data.replay.prioritized import ExpertPrioritizedSampler
    from ba_torchrl.data.replay.segment_tree import use_python_segment_trees
    from ba_torchrl.data.replay.storage import FrameStorage
    from ba_torchrl.data.replay.symmetric import SymmetricSampler
    from ba_torchrl.data.replay.writer import ExpertKeepingWriter
    from ba_torchrl.data.transitions import as_transitions

_MODULES = {
    "CenterCrop": "augmentation.views",
    "ExpertKeepingWriter": "replay.writer",
    "ExpertPrioritizedSampler": "replay.prioritized",
    "FrameReplayBuffer": "replay.buffer",
    "FrameStorage": "replay.storage",
    "ImageCodecs": "replay.codecs",
    "RandomViews": "augmentation.views",
    "RigidAugmentation": "augmentation.rigid",
    "SO2Augmentation": "augmentation.so2",
    "StoredCopies": "augmentation.so2",
    "SymmetricSampler": "replay.symmetric",
    "as_transitions": "transitions",
    "make_codecs": "replay.codecs",
    "make_replay": "replay.make",
    "use_python_segment_trees": "replay.segment_tree",
}
"""Modules of the names, imported at their first use: files and formats need no torch."""

__all__ = [
    "CenterCrop",
    "ExpertKeepingWriter",
    "ExpertPrioritizedSampler",
    "FrameReplayBuffer",
    "FrameStorage",
    "ImageCodecs",
    "RandomViews",
    "RigidAugmentation",
    "SO2Augmentation",
    "StoredCopies",
    "SymmetricSampler",
    "as_transitions",
    "make_codecs",
    "make_replay",
    "use_python_segment_trees",
]

__getattr__, __dir__ = lazy_names(__name__, _MODULES, __all__)
