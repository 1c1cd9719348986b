"""Compilation of functions by Numba, whose results are kept on disk where a folder is writable."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Mapping
from typing import Any


def njit(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the decorator `numba.njit` with a cache on disk; a first call imports Numba.

    Without a writable folder, a warning says so once and each process compiles the function.
    """
    return functools.partial(_Compiled, options=options)


class _Compiled:
    """A function that Numba compiles; those of its module are replaced by Numba's at a first call,
    so that they can call each other."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self._function, self._options = function, options

    def __call__(self, *args: Any) -> Any:
        return self._dispatcher(*args)

    @functools.cached_property
    def _dispatcher(self) -> Callable[..., Any]:
        names = self._function.__globals__
        for name, value in [*names.items()]:
            if isinstance(value, _Compiled):
                is_here = value._function.__globals__ is names
                names[name] = value._by_numba if is_here else value._dispatcher
        return self._by_numba

    @functools.cached_property
    def _by_numba(self) -> Callable[..., Any]:
        import numba

        try:
            return numba.njit(cache=True, **self._options)(self._function)
        except RuntimeError as error:
            if "cannot cache" not in str(error):
                raise
            _warn_once()
            return numba.njit(**self._options)(self._function)


@functools.cache
def _warn_once() -> None:
    warnings.warn(
        "compiled functions cannot be kept, so that each process compiles them anew (seconds): "
        "neither the folder of ba_torchrl nor the cache folder of the user is writable. Set "
        "NUMBA_CACHE_DIR to a folder that is",
        stacklevel=4,
    )
