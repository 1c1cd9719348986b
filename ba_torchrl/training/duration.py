"""Expected duration of a run's updates, from its first ones."""

from __future__ import annotations

import time

import torch

from ba_torchrl.algorithms.base import network_dtype
from ba_torchrl.hardware import processor
from ba_torchrl.training.config import ExperimentConfig

WARM_UP_UPDATES = 5
"""First updates, which are slower than later ones and not measured."""
MEASURED_UPDATES = 15


def compute_path(config: ExperimentConfig) -> str:
    """Return the number format of a run's network and the hardware that computes it."""
    device = config.torch_device
    number_format = str(network_dtype(config.network_config, device)).removeprefix("torch.")
    if device.type == "cuda":
        return f"{number_format} on {torch.cuda.get_device_name(device)}"
    if device.type == "cpu":
        return f"{number_format} on {processor()}, {torch.get_num_threads()} threads"
    return f"{number_format} on {device}"


class UpdateTimer:
    """Measures the mean duration of the first updates, without the very first."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Measure the following updates as if they were the first."""
        self._count = 0
        self._start = 0.0

    def exclude(self, seconds: float) -> None:
        """Leave out something else between two updates.

        Args:
            seconds: its duration.
        """
        self._start += seconds

    def tick(self) -> float | None:
        """Count an update that has ended.

        Returns:
            Seconds per update after the last measured one, collection between them included; else
            None.
        """
        self._count += 1
        if self._count == WARM_UP_UPDATES:
            self._start = time.perf_counter()
        if self._count != WARM_UP_UPDATES + MEASURED_UPDATES:
            return None
        return (time.perf_counter() - self._start) / MEASURED_UPDATES
