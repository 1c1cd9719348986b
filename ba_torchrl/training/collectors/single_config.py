"""Options of the collector in the learner's process."""

from __future__ import annotations

from typing import ClassVar

from ba_torchrl.training.collectors.config import COLLECTORS, CollectorConfig


@COLLECTORS.register("single")
class SingleConfig(CollectorConfig):
    """One step of all environments at a time, in the learner's process."""

    starter: ClassVar[str] = "ba_torchrl.training.collectors.single:start"
