"""Settings of the C library's allocator that make updates on the CPU about twice as fast."""

from __future__ import annotations

import ctypes
import functools
import platform

_M_TRIM_THRESHOLD = -1
_M_TOP_PAD = -2
_M_MMAP_MAX = -4


@functools.cache
def tune_malloc() -> bool:
    """Let this process keep the memory of large tensors that it has freed.

    By default glibc returns every large block to the kernel when it is freed, so each activation
    map is faulted in page by page at every update. Kept pages halve the time of an update of a
    large network and change no number. The price: the process stays as large as it ever was. Call
    this early; blocks that exist already are not affected. Calling it again does nothing.

    Returns:
        Whether the settings took effect: True with glibc on Linux, False elsewhere.
    """
    if platform.system() != "Linux" or platform.libc_ver()[0] != "glibc":
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    mallopt.argtypes = [ctypes.c_int, ctypes.c_int]
    mallopt.restype = ctypes.c_int
    settings = (
        (_M_MMAP_MAX, 0),  # large blocks come from the heap as well
        (_M_TRIM_THRESHOLD, 2**31 - 1),  # whose end is not given back
        (_M_TOP_PAD, 256 * 2**20),  # and which grows in large steps
    )
    applied = [mallopt(option, value) == 1 for option, value in settings]
    return all(applied)
