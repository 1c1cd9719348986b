"""Compiled loops over batches on the CPU, in as many threads as torch uses."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Barrier, Lock
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import get_proxy_mode

_lock = Lock()


def is_plain_float32(x: Tensor) -> bool:
    """Return whether a function of NumPy arrays may compute with ``x``.

    It must be a float32 tensor on the CPU with elements, outside of compilation, tracing,
    autocasting, ``torch.func`` and forward-mode differentiation, and no subclass of Tensor except
    Parameter.
    """
    return (
        type(x) in (Tensor, nn.Parameter)
        and x.dtype == torch.float32
        and x.device.type == "cpu"
        and x.numel() > 0
        and not torch.compiler.is_compiling()
        and not torch.jit.is_tracing()
        and get_proxy_mode() is None  # make_fx
        and not torch._C._are_functorch_transforms_active()
        and forward_ad._current_level < 0
        and not torch.is_autocast_enabled("cpu")
    )


def refuse_second_derivatives() -> None:
    """Raise a RuntimeError in a backward pass with ``create_graph``.

    A function that autograd cannot differentiate calls this first in its backward pass. In some
    cases the result of one that is only marked as `once_differentiable` counts as a constant.
    """
    if torch.is_grad_enabled():
        raise RuntimeError(
            "this layer has no second derivative on the CPU in float32 (create_graph=True); "
            "compute in another dtype"
        )


def in_parts(batch: int, work: Callable[[slice], Any]) -> list[Any]:
    """Return the results of work(slice) over equal parts of a batch, one part per thread.

    In the threads, matrix products do not start threads of their own. Below a dispatch mode, such
    as PyTorch's ``FlopCounterMode``, which sees one thread only, this thread does all the work.
    """
    with _lock:
        # The first number of a thread that is read while a pool starts would stay at one.
        count = min(torch.get_num_threads(), batch)
        is_single = count <= 1 or torch._C._len_torch_dispatch_stack()
        pool = None if is_single else _threads(count)
    bounds = [batch * i // count for i in range(count + 1)]
    parts = [slice(*bounds[i : i + 2]) for i in range(count)]
    if pool is None:
        return [work(part) for part in parts]
    try:
        results = [pool.submit(work, part) for part in parts]
    except RuntimeError:  # the interpreter ends
        return [work(part) for part in parts]
    return [result.result() for result in results]


def _use_one_thread() -> None:
    torch.get_num_threads()  # initialises torch in this thread, which would undo the next line
    torch.set_num_threads(1)


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    pool = ThreadPoolExecutor(count, "part-of-a-batch", initializer=_use_one_thread)
    # with a limit, as a thread that cannot be started would keep the others forever
    before, all_started = torch.get_num_threads(), Barrier(count, timeout=60.0)
    list(pool.map(lambda _: all_started.wait(), range(count)))
    torch.set_num_threads(before)  # the calls above also set it for threads that start later
    return pool


def _forget_threads() -> None:
    global _lock
    _lock = Lock()  # another thread may have held it
    _threads.cache_clear()


os.register_at_fork(after_in_child=_forget_threads)  # a child has none of the threads
