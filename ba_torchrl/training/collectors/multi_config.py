"""Options of the collectors with worker processes on this machine."""

from __future__ import annotations

from typing import ClassVar

from ba_torchrl.training.collectors.config import COLLECTORS, WorkersConfig


@COLLECTORS.register("multi_sync")
class MultiSyncConfig(WorkersConfig):
    """The workers step at the same time, all with the weights of the latest update."""

    starter: ClassVar[str] = "ba_torchrl.training.collectors.multi:start_sync"


@COLLECTORS.register("multi_async")
class MultiAsyncConfig(WorkersConfig):
    """The workers do not wait for each other, and step while the learner takes updates."""

    starter: ClassVar[str] = "ba_torchrl.training.collectors.multi:start_async"
