"""Seeds of a run's random numbers, by their use."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class SeedUse(IntEnum):
    """Uses of randomness in a run.

    Initial weights and the actions that SAC samples are drawn from torch's global generator, which
    is seeded with the seed of the run. Tests have seeds of their own; see
    `ba_torchrl.training.protocol`.
    """

    DEMONSTRATIONS = 0
    COLLECTION = 1
    EVALUATION = 2
    REPLAY = 5
    AUGMENTATION = 6
    EXPLORATION = 7
    VIEWS = 8
    """Random views of sampled images."""
    STORED_AUGMENTATION = 9
    """Augmented copies that are stored with each transition."""
    ENSEMBLE = 10
    """Subsets of an ensemble of critics."""
    MIXTURE = 11
    """Choice between the actions of policy and expert."""


def derive_seed(seed: int, use: SeedUse, part: int = 0) -> int:
    """Return the seed of one use of randomness in the run with a seed, or of one of its parts."""
    return int(np.random.SeedSequence([seed, use, part]).generate_state(1)[0])
