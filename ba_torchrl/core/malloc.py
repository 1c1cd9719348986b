"""Settings of glibc's memory allocator that make updates on the CPU about twice as fast."""

from __future__ import annotations

import ctypes
import functools
import platform

_M_TRIM_THRESHOLD = -1
_M_TOP_PAD = -2
_M_MMAP_MAX = -4


@functools.cache
def tune_malloc() -> bool:
    """Set glibc to keep the memory of freed large tensors for reuse.

    By default glibc returns every freed large block to the kernel, so every update causes page
    faults for each activation map. Reusing pages halves the time of an update of a large network
    and does not change results. The drawback is that the process never releases memory. Call this
    early: existing blocks are not affected. Further calls have no effect.

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
        (_M_TRIM_THRESHOLD, 2**31 - 1),  # the heap is never trimmed
        (_M_TOP_PAD, 256 * 2**20),  # the heap grows in large steps
    )
    applied = [mallopt(option, value) == 1 for option, value in settings]
    return all(applied)
