"""Augmented copies that are stored with each transition."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import nn


class StoredCopies(nn.Module):
    """Adds augmented copies after each transition that enters the replay.

    The reference implementation stores four rotated copies. They take five times the capacity and,
    in a prioritised replay, each copy has a priority of its own.

    Args:
        transform: augmentation of a batch of transitions.
        copies: number of copies of each transition.
    """

    def __init__(self, transform: nn.Module, copies: int) -> None:
        super().__init__()
        self.transform = transform
        self.copies = copies

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return transitions [N] as [N (copies + 1)], each followed by its copies."""
        copies = [self.transform(tensordict) for _ in range(self.copies)]
        return torch.stack([tensordict, *copies], dim=1).flatten(0, 1)
