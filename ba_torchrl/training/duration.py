"""Duration of a run by phase, and the expected duration of its updates, from its first ones."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import get_args

import torch

from ba_torchrl.algorithms.base import network_dtype
from ba_torchrl.core.hardware import processor
from ba_torchrl.record.results import Phase
from ba_torchrl.training.config import ExperimentConfig

WARM_UP_UPDATES = 5
"""First updates, which are slower than later ones and not measured."""
MEASURED_UPDATES = 15


def precision(config: ExperimentConfig) -> str:
    """Return the number format in which a run's networks compute on its device."""
    device = config.torch_device
    found = str(network_dtype(config.network_config, device)).removeprefix("torch.")
    if found != "float32" or device.type != "cuda" or not torch.backends.cudnn.allow_tf32:
        return found
    has_tf32 = torch.cuda.get_device_capability(device)[0] >= 8
    return "tf32" if has_tf32 else found


def compute_path(config: ExperimentConfig) -> str:
    """Return the number format of a run's network and the hardware that computes it."""
    device = config.torch_device
    number_format = precision(config)
    if device.type == "cuda":
        return f"{number_format} on {torch.cuda.get_device_name(device)}"
    if device.type == "cpu":
        return f"{number_format} on {processor()}, {torch.get_num_threads()} threads"
    return f"{number_format} on {device}"


class PhaseClock:
    """Wall time of a run by phase; its start is part of "other"."""

    def __init__(self) -> None:
        self._seconds: dict[Phase, float] = dict.fromkeys(get_args(Phase), 0.0)
        self._phase: Phase = "other"
        self._since = time.perf_counter()

    @contextmanager
    def phase(self, name: Phase) -> Iterator[None]:
        """Context whose time is that of a phase and not of the one around it."""
        before = self._phase
        self._switch(name)
        try:
            yield
        finally:
            self._switch(before)

    def add(self, seconds: Mapping[Phase, float]) -> None:
        """Add the time of the run before an interruption."""
        for name, value in seconds.items():
            self._seconds[name] += value

    def seconds(self) -> dict[Phase, float]:
        """Return the time of each phase until now."""
        self._switch(self._phase)
        return dict(self._seconds)

    def total(self) -> float:
        """Return the time of all phases until now."""
        return sum(self.seconds().values())

    def _switch(self, name: Phase) -> None:
        now = time.perf_counter()
        self._seconds[self._phase] += now - self._since
        self._phase, self._since = name, now


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
