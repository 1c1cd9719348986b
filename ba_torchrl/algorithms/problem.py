"""Description of a run for which an algorithm is built, and the seeds of its random numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import torch

from ba_torchrl.core.actions import CloseLoopActions, OpenLoopActions
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.modules.base import Control, NetworkConfig
from ba_torchrl.modules.layers import compute_dtype


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


@dataclass(frozen=True)
class Problem:
    """Description of the environments and the run for which an algorithm is built."""

    control: Control
    """Control of the task."""
    images: Mapping[str, ImageSpec]
    """Declarations of the images that the environment observes, by key."""
    actions: CloseLoopActions | OpenLoopActions
    """The action vector."""
    total_updates: int
    """Gradient updates of the run, the length of schedules."""
    seed: int
    device: torch.device
    vectors: Mapping[str, int] = field(default_factory=dict)
    """Length of each vector that the environment observes, by key."""
    center_m: tuple[float, float] = (0.0, 0.0)
    """x and y of the workspace's centre."""

    def derived_seed(self, use: SeedUse) -> int:
        """Return the run's seed for one use of randomness."""
        return derive_seed(self.seed, use)


def network_dtype(network: NetworkConfig, device: torch.device) -> torch.dtype:
    """Return the number format of a network's convolutions on a device; float32 for a network
    without the field ``precision``."""
    return compute_dtype(getattr(network, "precision", "float32"), device)
