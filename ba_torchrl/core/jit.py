"""Compilation of functions by Numba, whose results are kept on disk where a folder is writable."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any

import numba


def njit(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the decorator `numba.njit` with a cache on disk.

    Without a writable folder, a warning says so once and each process compiles the function.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError as error:
            if "cannot cache" not in str(error):
                raise
            _warn_once()
            return numba.njit(**options)(function)

    return decorate


@functools.cache
def _warn_once() -> None:
    warnings.warn(
        "compiled functions cannot be kept, so that each process compiles them anew (seconds): "
        "neither the folder of ba_torchrl nor the cache folder of the user is writable. Set "
        "NUMBA_CACHE_DIR to a folder that is",
        stacklevel=4,
    )
