"""Times of single layers, forward and backward, computed in different ways."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.modules.dynamic_filter import DynamicSteerableConv2d
from ba_torchrl.modules.irrep_convolution import irrep_convolution
from ba_torchrl.modules.kernel_blocks import regular_irrep_kernels
from ba_torchrl.modules.max_pool import relu_of_max_pool
from ba_torchrl.modules.steerable import (
    SteerableConv2d,
    planar_rotations,
    planar_rotations_and_flips,
)
from ba_torchrl.objectives.dqn import strict_large_margin
from ba_torchrl.profiling.learning import LearningUnit
from ba_torchrl.profiling.table import Bench, Row, measurement, timed_row

BATCH = 64
FIELDS = ((8, 16, 32), (16, 32, 16), (16, 32, 32), (64, 128, 8), (128, 64, 8))
"""Input fields, output fields and pixels of steerable convolutions in two actor-critics."""
LAYOUTS = {"contiguous": torch.contiguous_format, "channels-last": torch.channels_last}
MARGIN_VALUES = 128 * 128 * 16
"""Pixels times rotations."""
MARGIN = 0.1
HELD_BATCH = 8
"""Samples with an object in the gripper, for which a dynamic filter is computed."""
HELD_FIELDS = 16
HELD_PIXELS = 128
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


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
    gspace = planar_rotations(8)
    regular = gspace.regular_repr
    layer = SteerableConv2d(gspace, [(regular, in_fields)], [(regular, out_fields)], 3, padding=1)
    layer.to(bench.device)
    (coefficients,) = layer.coefficients.values()
    kernels = regular_irrep_kernels(gspace, regular)
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


def margin_in_a_loop(values: Tensor, chosen: Tensor, margin: float) -> Tensor:
    """Return the margin of each sample [B], computed one by one, as the reference implementation
    does.

    Args:
        values: [B, N].
        chosen: index of the demonstrated action of each sample [B].
        margin: added to the values of the other actions.
    """
    losses = []
    for of_sample, number in zip(values, chosen, strict=True):
        gap = of_sample - of_sample[number] + margin
        violating = (gap > 0).scatter(0, number, False)
        losses.append(gap[violating].mean() if violating.any() else 0 * of_sample.sum())
    return torch.stack(losses)


@measurement("learning/margin")
def measure_margin(bench: Bench) -> list[Row]:
    """SDQfD's margin of 16 samples, of which half are demonstrations."""
    values, experts = MARGIN_VALUES, slice(0, 8)
    q = torch.randn(16, values, device=bench.device)
    chosen = torch.randint(values, (16,), device=bench.device)

    name = f"SDQfD's margin, 16 x {values} values"
    calls = {
        f"{name}, all samples": lambda q: strict_large_margin(q, chosen, MARGIN),
        f"{name}, 8 demonstrations": lambda q: strict_large_margin(
            q[experts], chosen[experts], MARGIN
        ),
        f"{name}, 8 demonstrations in a loop": lambda q: margin_in_a_loop(
            q[experts], chosen[experts], MARGIN
        ),
    }
    return _rows(bench, {work: _with_gradient(call, q) for work, call in calls.items()})


def convolution_by_products(x: Tensor, filters: Tensor) -> Tensor:
    """Return the convolution of each sample with its own filter, by batched matrix products.

    Args:
        x: [B, C, H, W].
        filters: [B, C_out, C, K, K]; K is odd, and the map keeps its size.
    """
    batch, _, height, width = x.shape
    kernel = filters.shape[-1]
    padded = F.pad(x, [kernel // 2] * 4)
    y = x.new_zeros(batch, filters.shape[1], height * width)
    for i in range(kernel):
        for j in range(kernel):
            shifted = padded[:, :, i : i + height, j : j + width].flatten(2)
            y = torch.baddbmm(y, filters[..., i, j], shifted)
    return y.unflatten(2, (height, width))


@measurement("learning/dynamic_filter")
def measure_dynamic_filter(bench: Bench) -> list[Row]:
    """The dynamic 3x3 filter of D_4 in Equi ASR: a grouped convolution and matrix products."""
    gspace = planar_rotations_and_flips(4)
    layer = DynamicSteerableConv2d(gspace, gspace.regular_repr, HELD_FIELDS, 3).to(bench.device)
    coefficients = layer.scales().to(bench.device) * torch.randn(
        HELD_BATCH, layer.num_coefficients, device=bench.device
    )
    coefficients.requires_grad_()
    x = torch.randn(HELD_BATCH, 8 * HELD_FIELDS, HELD_PIXELS, HELD_PIXELS, device=bench.device)

    def products(x: Tensor) -> Tensor:
        filters, biases = layer.filters(coefficients)
        return convolution_by_products(x, filters) + biases[:, :, None, None]

    name = f"D4 dynamic filter, {HELD_FIELDS} fields, {HELD_PIXELS} px, batch {HELD_BATCH}"
    channels_last = x.to(memory_format=torch.channels_last)
    calls = {
        f"{name}, grouped convolution": _with_gradient(
            lambda x: layer(x, coefficients), channels_last
        ),
        f"{name}, matrix products": _with_gradient(products, x),
    }
    return _rows(bench, calls)


@measurement("learning/convolution_dtype")
def measure_dtypes(bench: Bench) -> list[Row]:
    """A convolution from 128 to 256 channels in two number formats."""
    calls = {}
    for name, dtype in DTYPES.items():
        convolution = nn.Conv2d(128, 256, 3, padding=1, device=bench.device, dtype=dtype)
        convolution.to(memory_format=torch.channels_last)
        x = torch.randn(BATCH, 128, 16, 16, device=bench.device, dtype=dtype)
        x = x.to(memory_format=torch.channels_last)
        work = f"3x3 convolution, 128 to 256 channels, 16 px, batch {BATCH}, {name}"
        calls[work] = _with_gradient(convolution, x)
    return _rows(bench, calls)
