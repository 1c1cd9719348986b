"""Construction of the replay that a configuration names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from torchrl.data.replay_buffers.samplers import RandomSampler, Sampler

from ba_torchrl.core.errors import check_choice
from ba_torchrl.core.generators import seeded_generator
from ba_torchrl.data.replay.buffer import FrameReplayBuffer
from ba_torchrl.data.replay.codecs import ImageCodec
from ba_torchrl.data.replay.prioritized import ExpertPrioritizedSampler
from ba_torchrl.data.replay.storage import FrameStorage
from ba_torchrl.data.replay.symmetric import SymmetricSampler

ReplayKind = Literal["uniform", "prioritized", "symmetric"]
"""How a batch is drawn: uniformly; by TD error with a bonus for demonstrations; or half of it
uniformly from the demonstrations and half uniformly from the other transitions."""


def make_replay(
    kind: ReplayKind,
    capacity: int,
    batch_size: int | None,
    *,
    codecs: Mapping[str, ImageCodec],
    seed: int,
    priority_exponent: float = 0.6,
    importance_exponent: float = 0.4,
    expert_bonus: float = 1.0,
    returns_codes: bool = False,
) -> FrameReplayBuffer:
    """Return an empty replay (appendix G.1, G.2).

    Args:
        kind: how a batch is drawn.
        capacity: number of transitions, demonstrations and others together.
        batch_size: of a sample; None if each call of ``sample`` passes it.
        codecs: codec of each image by key; the acting policy must use the same.
        seed: of the draws.
        priority_exponent: alpha of a prioritised replay.
        importance_exponent: initial beta of a prioritised replay, which
            ``replay.sampler.anneal`` raises.
        expert_bonus: added to the priority of demonstrations.
        returns_codes: samples hold the images' codes instead of decoded images.
    """
    check_choice("kind", kind, ReplayKind)
    sampler: Sampler = RandomSampler()
    if kind == "symmetric":
        sampler = SymmetricSampler(seed)
    elif kind == "prioritized":
        sampler = ExpertPrioritizedSampler(
            capacity,
            alpha=priority_exponent,
            beta=importance_exponent,
            expert_bonus=expert_bonus,
        )
    return FrameReplayBuffer(
        storage=FrameStorage(capacity, codecs, returns_codes=returns_codes),
        sampler=sampler,
        batch_size=batch_size,
        generator=seeded_generator(seed),
    )
