"""Lower limit of a duration: the work's multiply-adds at the measured speed of a matrix product."""

from __future__ import annotations

import contextlib
import statistics
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode, conv_backward_flop

SIZE = {"cpu": 2048, "cuda": 8192}
"""Rows and columns of the matrices by type of device, at which the speed no longer grows."""


class MatrixProduct:
    """Product of two square matrices.

    Args:
        dtype: number format of the matrices.
        device: where it is computed.
    """

    def __init__(self, dtype: torch.dtype, device: torch.device) -> None:
        size = SIZE.get(device.type, SIZE["cpu"])
        self.multiply_adds = size**3
        self._left, self._right, self._out = (
            torch.randn(size, size, device=device).to(dtype) for _ in range(3)
        )

    def __call__(self) -> None:
        """Compute the product."""
        torch.mm(self._left, self._right, out=self._out)

    def describe(self, times: Sequence[float]) -> str:
        """Return number format and median speed of the product.

        Args:
            times: seconds of calls.
        """
        speed = self.multiply_adds / statistics.median(times) / 1e9
        name = str(self._out.dtype).removeprefix("torch.")
        return f"{name} matrix product {speed:.3g} G/s"


def count_multiply_adds(call: Callable[[], Any]) -> int:
    """Return the number of multiply-adds in the convolutions and matrix products of a call.

    Gradients are included. torch counts two operations for each.

    Args:
        call: the function, which is called once.
    """
    corrected = {torch.ops.aten.convolution_backward: _convolution_backward}
    counter = FlopCounterMode(display=False, custom_mapping=corrected)
    counter.mod_tracker = _NoModules()
    with counter:
        call()
    return counter.get_total_flops() // 2


class _NoModules(contextlib.nullcontext):
    """Replaces the attribution to modules, which fails for a module that is a TensorDict."""

    parents = ("Global",)


def _convolution_backward(*args: Any, out_shape: Sequence[Sequence[int]]) -> int:
    """Return torch's count with that of the filters' gradient divided by the number of groups.

    torch 2.13 counts this gradient as if every output channel had all input channels.

    Args:
        args: those of ``aten.convolution_backward``, shapes in place of tensors.
        out_shape: shapes of its results.
    """
    *others, groups, (for_input, for_filters, _) = args
    of_input = conv_backward_flop(*others, groups, (for_input, False), out_val=out_shape)
    of_filters = conv_backward_flop(*others, groups, (False, for_filters), out_val=out_shape)
    return of_input + of_filters // groups
