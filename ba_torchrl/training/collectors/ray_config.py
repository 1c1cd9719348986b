"""Options of the collector with workers of a Ray cluster."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from ba_torchrl.training.collectors.config import COLLECTORS, WorkersConfig
from ba_torchrl.training.ray_cluster import check_installed, check_resources, connected_ray


@COLLECTORS.register("ray")
class RayCollectorConfig(WorkersConfig):
    """Workers of a Ray cluster, each a Ray actor; they do not wait for each other.

    Ray starts a worker of a machine that fails again on another one that has the resources. If a
    worker fails more than ``max_restarts`` times before it returns a batch, collection ends; ends
    of its process in the construction of its environments do not count.
    """

    starter: ClassVar[str] = "ba_torchrl.training.collectors.ray:start"
    resources: ClassVar[frozenset[str]] = frozenset({"workers", "cpus", "gpus", "address"})

    cpus: float = Field(default=1.0, ge=0)
    """CPU cores that Ray reserves for each worker."""
    gpus: float = Field(default=0.0, ge=0)
    """GPUs that Ray reserves for each worker; the policy of a worker runs on the CPU."""
    address: str | None = None
    """Address of the cluster, such as "auto"; None for `ray.init`'s default, which starts a
    cluster of this machine if it is not part of one."""

    def check(self, num_envs: int) -> None:
        """Check that Ray is installed, and what `WorkersConfig` checks."""
        super().check(num_envs)
        check_installed("collector")

    def connect(self) -> None:
        """Connect to the cluster, and check that it has the resources that the workers need."""
        connected_ray(self.address)
        check_resources("collector", self.workers * self.cpus, self.workers * self.gpus)
