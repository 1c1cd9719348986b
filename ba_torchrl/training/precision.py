"""Number format in which a run's network computes, and the hardware that computes it."""

from __future__ import annotations

import torch

from ba_torchrl.algorithms.problem import network_dtype
from ba_torchrl.core.hardware import processor
from ba_torchrl.training.config import ExperimentConfig


def precision(config: ExperimentConfig) -> str:
    """Return the number format in which a run's networks compute on its device."""
    device = config.torch_device
    found = str(network_dtype(config.network, device)).removeprefix("torch.")
    if found != "float32" or device.type != "cuda" or not torch.backends.cudnn.allow_tf32:
        return found
    return "tf32" if torch.cuda.get_device_capability(device)[0] >= 8 else found


def compute_path(config: ExperimentConfig) -> str:
    """Return the number format of a run's network and the hardware that computes it."""
    device = config.torch_device
    names = {
        "cuda": torch.cuda.get_device_name,
        "cpu": lambda _: f"{processor()}, {torch.get_num_threads()} threads",
    }
    return f"{precision(config)} on {names.get(device.type, str)(device)}"
