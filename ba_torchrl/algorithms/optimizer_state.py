"""States of optimisers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch


def fits(optimizer: torch.optim.Optimizer, state: Mapping[str, Any]) -> bool:
    """Return whether the moments in a ``state_dict`` have the shapes of the parameters."""
    groups = state["param_groups"]
    if len(groups) != len(optimizer.param_groups):
        return False
    for group, saved in zip(optimizer.param_groups, groups, strict=True):
        if len(group["params"]) != len(saved["params"]):
            return False
        for parameter, index in zip(group["params"], saved["params"], strict=True):
            moments = state["state"].get(index, {}).get("exp_avg")
            if moments is not None and moments.shape != parameter.shape:
                return False
    return True
