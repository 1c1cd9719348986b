"""Copies of batches to the learner's device, for which the host does not wait."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ba_torchrl.data.replay.codecs import ImageCodec
from ba_torchrl.envs import keys


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


def decoded_on_device(
    batch: TensorDictBase, codecs: Mapping[str, ImageCodec], device: torch.device
) -> TensorDictBase:
    """Return a batch whose images are decoded on a device; other entries are those of the batch.

    Args:
        batch: transitions [B] with the images' codes, on the CPU.
        codecs: codec of each image by key.
        device: where the images are decoded.
    """
    batch = batch.copy().clear_device_()
    for key, codec in codecs.items():
        for nested in (key, (keys.NEXT, key)):
            batch.set(nested, codec.decode(to_device(batch[nested], device)))
    return batch


def batch_to_device(batch: TensorDictBase, device: torch.device) -> TensorDictBase:
    """Return a batch with all entries on a device; see `to_device`."""
    return batch.apply(lambda value: to_device(value, device), device=device)
