"""Times of single layers, forward and backward, computed in different ways."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from ba_torchrl.modules.steerable.irrep_convolution import irrep_convolution
from ba_torchrl.modules.steerable.kernels import regular_irrep_kernels
from ba_torchrl.modules.steerable.layers import SteerableConv2d
from ba_torchrl.modules.steerable.max_pool import relu_of_max_pool
from ba_torchrl.modules.steerable.planar import planar_rotations
from profiling.learning import LearningUnit
from profiling.table import Bench, Row, measurement, timed_row

BATCH = 64
FIELDS = ((8, 16, 32), (16, 32, 16), (16, 32, 32), (64, 128, 8), (128, 64, 8))
"""Input fields, output fields and pixels of steerable convolutions in two actor-critics."""
LAYOUTS = {"contiguous": torch.contiguous_format, "channels-last": torch.channels_last}


def _with_gradient(layer: Callable[[Tensor], Tensor], x: Tensor) -> Callable[[], None]:
    """Return the forward and backward pass of a layer."""
    x = x.detach().requires_grad_()
    grad = torch.ones_like(layer(x).detach())

    def run() -> None:
        x.grad = None
        layer(x).backward(grad)

    return run


def _rows(bench: Bench, calls: dict[str, Callable[[], None]]) -> list[Row]:
    times = bench.time_against({"unit": LearningUnit(bench.device)}, calls)
    return [timed_row(call, "ms", times[call], times["unit"]) for call in calls]


@measurement("learning/steerable_convolution", over=lambda: FIELDS)
def measure_steerable(bench: Bench, in_fields: int, out_fields: int, pixels: int) -> list[Row]:
    """A 3x3 steerable convolution of C_8 with the expanded filter and in the basis of irreps."""
    regular = planar_rotations(8).regular_repr
    layer = SteerableConv2d([(regular, in_fields)], [(regular, out_fields)], 3, padding=1)
    layer.to(bench.device)
    (coefficients,) = layer.coefficients.values()
    kernels = regular_irrep_kernels(regular)
    x = torch.randn(BATCH, 8 * in_fields, pixels, pixels, device=bench.device)

    def expanded(x: Tensor) -> Tensor:
        weight, bias = layer.expand()
        return F.conv2d(x, weight, bias, padding=1)

    def irreps(x: Tensor) -> Tensor:
        return irrep_convolution(x, kernels, coefficients, layer.expand_bias(), 1)

    name = f"C8 convolution, {in_fields} to {out_fields} fields, {pixels} px, batch {BATCH}"
    channels_last = x.to(memory_format=torch.channels_last)
    calls = {f"{name}, expanded filter": _with_gradient(expanded, channels_last)}
    if bench.device.type == "cpu":
        calls[f"{name}, basis of irreps"] = _with_gradient(irreps, x)
    return _rows(bench, calls)


@measurement("learning/max_pool", over=lambda: [(layout,) for layout in LAYOUTS])
def measure_max_pool(bench: Bench, layout: str) -> list[Row]:
    """ReLU of the 2x2 max pool by PyTorch's functions and in one pass, also with a slope."""
    x = torch.randn(BATCH, 128, 64, 64, device=bench.device).to(memory_format=LAYOUTS[layout])
    name = f"ReLU of max pool, 128 channels, 64 px, batch {BATCH}, {layout}"
    calls = {
        f"{name}, PyTorch": _with_gradient(lambda x: F.relu(F.max_pool2d(x, 2)), x),
        f"{name}, one pass": _with_gradient(relu_of_max_pool, x),
        f"{name}, one pass, slope 0.1": _with_gradient(lambda x: relu_of_max_pool(x, 0.1), x),
    }
    return _rows(bench, calls)
