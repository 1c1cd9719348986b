"""Numbers of the widest floating type of a device."""

from __future__ import annotations

import torch
from torch import Tensor

from ba_torchrl.modules.cached_constant import cached_constant

WITHOUT_FLOAT64 = {"mps"}
"""Types of devices that have no float64."""


def widest_float(device: torch.device) -> torch.dtype:
    """Return float64, or float32 on a device that has no float64."""
    return torch.float32 if device.type in WITHOUT_FLOAT64 else torch.float64


def widened(value: Tensor) -> Tensor:
    """Return a tensor in the widest floating type of its device."""
    return value.to(widest_float(value.device))


@cached_constant()
def constants(values: tuple[float, ...], device: torch.device) -> Tensor:
    """Return numbers [n] in the widest floating type of a device; they are copied to it once."""
    return torch.tensor(values, dtype=widest_float(device), device=device)
