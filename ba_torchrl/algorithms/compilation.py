"""Losses compiled by `torch.compile`."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.objectives import LossModule

CompileMode = Literal["default", "reduce-overhead", "max-autotune"]
"""Mode of `torch.compile`; all but the first replay CUDA graphs on a GPU."""


class CompiledLoss:
    """A loss module whose forward and backward pass are compiled at the first call.

    Compilation is for the shapes of this call. The results are copies, since a CUDA graph writes
    those of the next call to the same memory.

    Args:
        loss: the module, which is compiled in place.
        mode: of `torch.compile`.
    """

    def __init__(self, loss: LossModule, mode: CompileMode) -> None:
        self.loss = loss
        _ = loss.in_keys  # determined at their first use, which would be compiled
        loss.compile(mode=mode, dynamic=False)

    def __call__(self, batch: TensorDictBase) -> TensorDict:
        """Return the losses and diagnostics of a batch, into which the loss writes priorities."""
        torch.compiler.cudagraph_mark_step_begin()
        known = set(batch.keys(True, True))
        scalars = self.loss(batch).clone()
        written = [key for key in batch.keys(True, True) if key not in known]
        batch.update({key: batch[key].clone() for key in written})
        return scalars
