"""Options of the collectors, and their registry."""

from __future__ import annotations

from collections.abc import Sequence
from pkgutil import resolve_name
from typing import Any, ClassVar

from pydantic import Field

from ba_torchrl.core.config import StrictModel
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.registry import Registry


class CollectorConfig(StrictModel):
    """Options of a collector.

    Its module imports no torch: this package's classes name in `starter` what starts to collect.
    Another one can override `start` instead.
    """

    starter: ClassVar[str]
    """The function that `start` imports and calls with the options and its own arguments, as
    "module:function"."""
    resources: ClassVar[frozenset[str]] = frozenset()
    """Fields that do not affect learning; a resumed run may have other values."""

    def check(self, num_envs: int) -> None:
        """Raise `ConfigError` unless the collector can be used, before anything starts."""
        return

    def connect(self) -> None:
        """Raise `ConfigError` unless the collector's machines can be used; a run begins with it."""
        return

    def start(self, problem: Any, positions: Sequence[Any] | None) -> Any:
        """Start to collect; return a `ba_torchrl.training.collectors.base.Collection`.

        Args:
            problem: the run's environments and policy, a `CollectionProblem`.
            positions: that `Collection.get_positions` returned, from which the environments
                continue; None to start new episodes.
        """
        return resolve_name(self.starter)(self, problem, positions)


class WorkersConfig(CollectorConfig):
    """Options of every collector with workers."""

    resources: ClassVar[frozenset[str]] = frozenset({"workers"})

    workers: int = Field(default=2, ge=1)
    """Number of workers; each runs an equal number of the environments."""
    steps_per_batch: int = Field(default=1, ge=1)
    """Steps of each environment between two deliveries of transitions and of weights."""

    def check(self, num_envs: int) -> None:
        """Raise `ConfigError` unless the workers can share the environments equally."""
        if num_envs % self.workers:
            envs = -(-num_envs // self.workers) * self.workers
            raise ConfigError(
                f"collector.workers: {self.workers} workers cannot share num_envs={num_envs} "
                f"environments equally; set num_envs={envs}"
            )


COLLECTORS: Registry[type[CollectorConfig]] = Registry(
    "collector", "ba_torchrl.training.collectors", CollectorConfig, "_config"
)
