"""Compiled loops over batches on the CPU, in as many threads as torch uses."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Barrier
from typing import Any

import torch
from torch import Tensor, nn


def is_plain_float32(x: Tensor) -> bool:
    """Return whether a function of NumPy arrays may compute with ``x``.

    It must be a float32 tensor on the CPU with elements, outside of compilation, tracing and
    autocasting, and no subclass of Tensor except Parameter.
    """
    return (
        type(x) in (Tensor, nn.Parameter)
        and x.dtype == torch.float32
        and x.device.type == "cpu"
        and x.numel() > 0
        and not torch.compiler.is_compiling()
        and not torch.jit.is_tracing()
        and not torch.is_autocast_enabled("cpu")
    )


def in_parts(batch: int, work: Callable[[slice], Any]) -> list[Any]:
    """Return the results of work(slice) over equal parts of a batch, one part per thread.

    In the threads, matrix products do not start threads of their own. Below a dispatch mode, such
    as PyTorch's ``FlopCounterMode``, which sees one thread only, this thread does all the work.
    """
    count = min(torch.get_num_threads(), batch)
    bounds = [batch * i // count for i in range(count + 1)]
    parts = [slice(*bounds[i : i + 2]) for i in range(count)]
    if count == 1 or torch._C._len_torch_dispatch_stack():
        return [work(part) for part in parts]
    return list(_threads(count).map(work, parts))


def _use_one_thread() -> None:
    torch.get_num_threads()  # initialises torch in this thread, which would undo the next line
    torch.set_num_threads(1)


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    pool = ThreadPoolExecutor(count, "part-of-a-batch", initializer=_use_one_thread)
    before, all_started = torch.get_num_threads(), Barrier(count)
    list(pool.map(lambda _: all_started.wait(), range(count)))
    torch.set_num_threads(before)  # the calls above also set it for threads that start later
    return pool


os.register_at_fork(after_in_child=_threads.cache_clear)  # a child has none of the threads
