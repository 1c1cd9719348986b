"""Description of a run for which an algorithm is built."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

from ba_torchrl.core.actions import CloseLoopActions, OpenLoopActions
from ba_torchrl.core.choices import Control
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.core.seeds import SeedUse, derive_seed
from ba_torchrl.modules.config import NetworkConfig
from ba_torchrl.modules.layers import compute_dtype


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
    equal_moves: int = 0
    """Number of actions in the expert's sets of equal moves; 0 if it gives none."""

    def derived_seed(self, use: SeedUse) -> int:
        """Return the run's seed for one use of randomness."""
        return derive_seed(self.seed, use)


def network_dtype(network: NetworkConfig, device: torch.device) -> torch.dtype:
    """Return the number format of a network's convolutions on a device; float32 for a network
    without the field ``precision``."""
    return compute_dtype(getattr(network, "precision", "float32"), device)
