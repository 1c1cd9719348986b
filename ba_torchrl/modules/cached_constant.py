"""Values that are computed once per process, also in compiled graphs."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import TypeVar

import torch

Value = TypeVar("Value")


def cached_constant(
    maxsize: int | None = None,
) -> Callable[[Callable[..., Value]], Callable[..., Value]]:
    """Return a decorator for functions of hashable arguments, which `torch.compile` does not trace.

    `torch.compile` ignores the cache of `functools.lru_cache` and would compute the result in each
    call of a graph.

    Args:
        maxsize: number of results that are kept; None for all.
    """

    def decorate(function: Callable[..., Value]) -> Callable[..., Value]:
        cached = lru_cache(maxsize)(function)

        @wraps(function)
        def call(*args: object) -> Value:
            # a tensor of inference mode could not be used in a later training step
            with torch.inference_mode(False):
                return cached(*args)

        call.cache_clear = cached.cache_clear
        return torch.compiler.assume_constant_result(call)

    return decorate
