"""Options of the launcher on a Ray cluster."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from pydantic import Field

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.training.collectors.ray_config import RayCollectorConfig
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.grid.launchers.base import LAUNCHERS, LauncherConfig
from ba_torchrl.training.ray_cluster import check_installed


@LAUNCHERS.register("ray")
class RayLauncherConfig(LauncherConfig):
    """One task of a Ray cluster for each run; as many run at a time as its resources allow.

    All machines see the grid's folder under the same absolute path. A run whose machine or process
    fails is resumed on another machine from its last saved state.
    """

    runner: ClassVar[str] = "ba_torchrl.training.grid.launchers.ray:run_all"

    cpus: float = Field(default=1.0, ge=0)
    """CPU cores that Ray reserves for each run."""
    gpus: float = Field(default=0.0, ge=0)
    """GPUs that Ray reserves for each run."""
    max_retries: int = Field(default=3, ge=0)
    """Largest number of times that a run is repeated because its machine or process failed."""
    address: str | None = None
    """Address of the cluster, such as "auto"; None for `ray.init`'s default, which starts a
    cluster of this machine if it is not part of one."""

    def check(self, runs: Sequence[ExperimentConfig]) -> None:
        """Check that Ray is installed, and that no run starts workers of its own on the cluster."""
        check_installed("launcher")
        if any(isinstance(run.collector, RayCollectorConfig) for run in runs):
            raise ConfigError(
                "launcher=ray with collector=ray: runs that hold the cluster would wait for their "
                "own workers; use one of the two"
            )
