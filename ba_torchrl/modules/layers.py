"""Shared by all networks: number formats, constants of a process, plain layers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import wraps
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.core import hardware
from ba_torchrl.core.choices import Precision
from ba_torchrl.core.errors import BatchError, layout

Value = TypeVar("Value")

for _constant in (hardware.amx_is_used, hardware.bfloat16_is_fast):
    torch.compiler.assume_constant_result(_constant)  # here, since it imports torch's compiler


def real_tensors(function: Callable[..., Value]) -> Callable[..., Value]:
    """Decorate a function whose tensors are for the whole process.

    They are on the CPU and have values, whatever the caller's context is: a new thread is in no
    `torch.device` context, fake mode of an export, transform or `torch.inference_mode`.
    """

    @wraps(function)
    def call(*args: Any) -> Value:
        with ThreadPoolExecutor(1) as thread:
            return thread.submit(function, *args).result()

    return call


def can_be_kept(value: object) -> bool:
    """Return whether a result of a forward pass may be used in other forward passes.

    A fake tensor of an export, and a tensor inside a transform of ``torch.func``, may not. What
    `torch.compile` keeps is the tensor of the compiled call.
    """
    if torch.compiler.is_dynamo_compiling() or not isinstance(value, Tensor):
        return True
    return type(value) is Tensor and not torch._C._functorch.is_functorch_wrapped_tensor(value)


def cached_constant(
    maxsize: int | None = None,
) -> Callable[[Callable[..., Value]], Callable[..., Value]]:
    """Return a decorator for functions of hashable positional arguments.

    `torch.compile` ignores the cache of `functools.lru_cache` and would compute the result in each
    call of a graph. It reads this one, whose entries are inputs of the graph, and compiles a graph
    again in whose first call an entry was missing. Results that `can_be_kept` refuses are not kept.

    Args:
        maxsize: number of results that are kept, the newest ones; None for all.
    """

    def decorate(function: Callable[..., Value]) -> Callable[..., Value]:
        results: dict[tuple, Value] = {}

        @wraps(function)
        def call(*args: object) -> Value:
            if args not in results:
                # a tensor of inference mode could not be used in a later training step
                with torch.inference_mode(False):
                    result = function(*args)
                if not can_be_kept(result):
                    return result
                if maxsize is not None and len(results) >= maxsize:
                    del results[next(iter(results))]
                results[args] = result
                return result
            return results[args]

        call.cache_clear = results.clear
        return call

    return decorate


WITHOUT_FLOAT64 = {"mps"}
"""Types of devices that have no float64."""


def widest_float(device: torch.device) -> torch.dtype:
    """Return float64, or float32 on a device that has no float64."""
    return torch.float32 if device.type in WITHOUT_FLOAT64 else torch.float64


def widened(value: Tensor) -> Tensor:
    """Return a tensor in the widest floating type of its device."""
    return value.to(widest_float(value.device))


@cached_constant()
def constants(values: tuple[float, ...], device: torch.device) -> Tensor:
    """Return numbers [n] in the widest floating type of a device; they are copied to it once."""
    return torch.tensor(values, dtype=widest_float(device), device=device)


@cached_constant()
def _bfloat16_is_fast(device_type: str) -> bool:
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device_type == "cpu":
        return hardware.bfloat16_is_fast()
    return False


def compute_dtype(precision: Precision, device: torch.device) -> torch.dtype:
    """Return the number format that convolutions on ``device`` use.

    Args:
        precision: "auto" is bfloat16 if the hardware multiplies it faster than float32, else
            float32.
    """
    if precision == "auto":
        return torch.bfloat16 if _bfloat16_is_fast(device.type) else torch.float32
    return getattr(torch, precision)


def check_image(key: str, image: Tensor, shape: Sequence[int]) -> None:
    """Raise `BatchError` unless an image has the shape that a network was built for.

    Args:
        key: of the image.
        image: [..., C, H, W], of a floating type.
        shape: [C, H, W].
    """
    if image.shape[-3:] != shape or not image.is_floating_point():
        raise BatchError(
            f"{key!r} is {layout(image.dtype, image.shape)}, and must be of a floating type and "
            f"end in {list(shape)}: channels, rows and columns that the network was built for"
        )


def scaled_width(width: int, scale: float) -> int:
    """Return ``width`` times ``scale``, rounded, at least one."""
    return max(1, math.floor(width * scale + 0.5))


class CastConv2d(nn.Conv2d):
    """A convolution that computes in its input's dtype and keeps float32 parameters."""

    def forward(self, x: Tensor) -> Tensor:
        """Return the convolution of x [B, C, H, W], in x's dtype."""
        bias = None if self.bias is None else self.bias.to(x.dtype)
        return F.conv2d(x, self.weight.to(x.dtype), bias, self.stride, self.padding)


class XavierInitialised(nn.Module):
    """A network with Xavier-initialised convolutions and linear layers."""

    def reset_parameters(self) -> None:
        """Draw their weights anew; steerable layers, and linear layers of a subclass, draw theirs
        by ``reset_parameters`` of their own."""
        self.apply(_xavier)


def _xavier(module: nn.Module) -> None:
    if isinstance(module, nn.Conv2d):
        nn.init.xavier_normal_(module.weight)
    elif type(module) is nn.Linear:
        nn.init.xavier_uniform_(module.weight)
        nn.init.zeros_(module.bias)
