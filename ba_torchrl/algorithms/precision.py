"""The number format that a network computes in."""

from __future__ import annotations

import torch

from ba_torchrl.algorithms.base import NetworkConfig
from ba_torchrl.modules.layers import compute_dtype


def network_dtype(network: NetworkConfig, device: torch.device) -> torch.dtype:
    """Return the number format of a network's convolutions; float32 for one without the field
    ``precision``.

    Args:
        network: hyper-parameters.
        device: where it is computed.
    """
    return compute_dtype(getattr(network, "precision", "float32"), device)
