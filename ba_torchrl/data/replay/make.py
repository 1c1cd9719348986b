"""Construction of the replay that a configuration names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from ba_torchrl.data.replay.buffer import FrameReplayBuffer, make_replay_buffer
from ba_torchrl.data.replay.codecs import ImageCodec
from ba_torchrl.data.replay.symmetric import SymmetricReplay

ReplayKind = Literal["uniform", "prioritized", "symmetric"]
"""How a batch is drawn: uniformly; by TD error with a bonus for demonstrations; or half of it
uniformly from the demonstrations and half uniformly from the other transitions."""


def make_replay(
    kind: ReplayKind,
    capacity: int,
    batch_size: int,
    *,
    codecs: Mapping[str, ImageCodec],
    seed: int,
    priority_exponent: float = 0.6,
    weight_exponent: float = 0.4,
    expert_bonus: float = 1.0,
    returns_codes: bool = False,
) -> FrameReplayBuffer | SymmetricReplay:
    """Return an empty replay.

    Args:
        kind: how a batch is drawn.
        capacity: number of transitions; for a symmetric replay, in each half.
        batch_size: of a sample.
        codecs: codec of each image by key.
        seed: of the draws.
        priority_exponent: alpha of a prioritised replay.
        weight_exponent: initial beta of a prioritised replay.
        expert_bonus: added to the priority of demonstrations.
        returns_codes: samples hold the images' codes instead of decoded images.
    """
    if kind == "symmetric":
        return SymmetricReplay(
            capacity, batch_size, codecs=codecs, seed=seed, returns_codes=returns_codes
        )
    return make_replay_buffer(
        capacity,
        batch_size,
        codecs=codecs,
        seed=seed,
        prioritized=kind == "prioritized",
        priority_exponent=priority_exponent,
        weight_exponent=weight_exponent,
        expert_bonus=expert_bonus,
        returns_codes=returns_codes,
    )
