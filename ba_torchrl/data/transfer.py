"""Copies of batches to the learner's device, for which the host does not wait."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor


def to_device(value: Tensor, device: torch.device) -> Tensor:
    """Return a tensor on a device; the host does not wait for a CUDA device.

    Args:
        value: a tensor. A float64 one becomes float32 on a device of type "mps", which has no
            float64.
        device: where the result is.
    """
    if value.device == device:
        return value
    if device.type == "mps" and value.dtype == torch.float64:
        value = value.float()
    if device.type == "cuda" and value.device.type == "cpu":
        return value.pin_memory().to(device, non_blocking=True)
    return value.to(device)


def batch_to_device(batch: TensorDictBase, device: torch.device) -> TensorDictBase:
    """Return a batch with all entries on a device; see `to_device`."""
    return batch.apply(lambda value: to_device(value, device), device=device)
