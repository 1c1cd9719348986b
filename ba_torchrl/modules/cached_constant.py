"""Values that are computed once per process, also beside compiled graphs."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar

import torch

Value = TypeVar("Value")


def cached_constant(
    maxsize: int | None = None,
) -> Callable[[Callable[..., Value]], Callable[..., Value]]:
    """Return a decorator for functions of hashable positional arguments.

    `torch.compile` ignores the cache of `functools.lru_cache` and would compute the result in each
    call of a graph. It reads this one, whose entries are inputs of the graph, and compiles a graph
    again in whose first call an entry was missing.

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
                if maxsize is not None and len(results) >= maxsize:
                    del results[next(iter(results))]
                results[args] = result
                return result
            return results[args]

        call.cache_clear = results.clear
        return call

    return decorate
