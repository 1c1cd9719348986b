"""Replay, sampling and augmentation."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ba_torchrl.core.lazy import lazy_names

if TYPE_CHECKING:
    from ba_torchrl.data.augmentation.rigid import RigidAugmentation as RigidAugmentation
    from ba_torchrl.data.augmentation.so2 import (
        SO2Augmentation as SO2Augmentation,
        StoredCopies as StoredCopies,
    )
    from ba_torchrl.data.augmentation.views import (
        CenterCrop as CenterCrop,
        RandomViews as RandomViews,
    )
    from ba_torchrl.data.replay.buffer import FrameReplayBuffer as FrameReplayBuffer
    from ba_torchrl.data.replay.codecs import ImageCodecs as ImageCodecs, make_codecs as make_codecs
    from ba_torchrl.data.replay.make import make_replay as make_replay
    from ba_torchrl.data.replay.prioritized import (
        ExpertPrioritizedSampler as ExpertPrioritizedSampler,
    )
    from ba_torchrl.data.replay.segment_tree import (
        use_python_segment_trees as use_python_segment_trees,
    )
    from ba_torchrl.data.replay.storage import FrameStorage as FrameStorage
    from ba_torchrl.data.replay.symmetric import SymmetricSampler as SymmetricSampler
    from ba_torchrl.data.replay.writer import ExpertKeepingWriter as ExpertKeepingWriter
    from ba_torchrl.data.transitions import as_transitions as as_transitions


__getattr__, __dir__, __all__ = lazy_names(__name__)
