"""Functions on the host of results of the learner's device."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

HostTask = Callable[[dict[str, Tensor]], None]
IS_FINITE = "is_finite"


class HostTasks:
    """Functions of results of a device that run on the host.

    On a CUDA device a result is copied to the host while the host goes on, and its function runs in
    a later call of `run`. On other devices it runs at once.

    Args:
        device: of the results.
        is_deferred: whether functions run later; None for the rule above.
    """

    def __init__(self, device: torch.device, *, is_deferred: bool | None = None) -> None:
        self.device = device
        self.is_deferred = device.type == "cuda" if is_deferred is None else is_deferred
        self._waiting: deque[tuple[torch.Event | None, dict[str, Tensor], HostTask]] = deque()

    def __len__(self) -> int:
        """Number of functions that have not run."""
        return len(self._waiting)

    def submit(self, values: Mapping[str, Tensor], task: HostTask) -> None:
        """Call a function on the host, now or later.

        Args:
            values: its argument, by name; later changes of these tensors have no effect.
            task: the function.
        """
        values = {name: value.detach() for name, value in values.items()}
        if not self.is_deferred:
            task({name: value.cpu() for name, value in values.items()})
            return
        is_cuda, event = self.device.type == "cuda", None
        copies = {}
        for name, value in values.items():
            copy = torch.empty(value.shape, dtype=value.dtype, device="cpu", pin_memory=is_cuda)
            copies[name] = copy.copy_(value, non_blocking=True)
        if is_cuda:
            event = torch.Event(self.device)
            event.record()
        self._waiting.append((event, copies, task))

    def run(self, count: int | None = None) -> None:
        """Run the functions that were submitted first, once their results are on the host.

        If one raises an error, the others are dropped.

        Args:
            count: how many; None for all.
        """
        for _ in range(len(self) if count is None else count):
            event, values, task = self._waiting.popleft()
            if event is not None:
                event.synchronize()
            try:
                task(values)
            except BaseException:
                self._waiting.clear()
                raise


def check_finite(update: int, scalars: dict[str, Tensor]) -> None:
    """Check the losses of an update.

    Args:
        update: its number.
        scalars: losses and diagnostics, and under `IS_FINITE` whether the losses' sum is finite.

    Raises:
        FloatingPointError: it is not.
    """
    if scalars.pop(IS_FINITE):
        return
    values = {key: value.item() for key, value in scalars.items()}
    raise FloatingPointError(f"a loss is not finite at update {update}: {values}")
