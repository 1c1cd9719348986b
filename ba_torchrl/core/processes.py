"""Processes that end with the process that started them."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def end_with(parent: int, by: signal.Signals = signal.SIGKILL) -> None:
    """Let the kernel send a signal to this process when its parent ends, however it ends.

    Args:
        parent: process id of the parent. The thread that started this process is one that lasts as
            long as the parent.
        by: the signal. SIGKILL ends this process even if it hangs or is stopped.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, int(by))
        if os.getppid() != parent:  # it ended before
            os._exit(1)
