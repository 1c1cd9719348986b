"""The collector with workers on the machines of a Ray cluster, through TorchRL's RayCollector."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import EnvBase

from ba_torchrl.core.seeds import SeedUse, derive_seed
from ba_torchrl.envs.episode_positions import EpisodePosition
from ba_torchrl.training.collectors.base import CollectionProblem
from ba_torchrl.training.collectors.ray_config import RayCollectorConfig
from ba_torchrl.training.collectors.workers import WorkerCollection, failed_too_often
from ba_torchrl.training.ray_cluster import ray_module

_FOREVER = sys.maxsize


def start(
    config: RayCollectorConfig, problem: CollectionProblem, _: Sequence[EpisodePosition] | None
) -> RayCollection:
    """Start to collect; see `CollectorConfig.start`. The environments start new episodes."""
    return RayCollection(problem, config)


class RayCollection(WorkerCollection):
    """Batches of the workers of a Ray cluster, in the order in which they arrive.

    A worker receives the latest weights before each of its batches. Batches of a restarted worker
    without weights are left out.

    Args:
        problem: the run's environments and policy.
        config: number of workers, size of batches and resources.

    Raises:
        ConfigError: there is no cluster at the address, or it has fewer resources than the workers
            need.
    """

    config: RayCollectorConfig

    def __init__(self, problem: CollectionProblem, config: RayCollectorConfig) -> None:
        super().__init__(problem, config)
        config.connect()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # the policy is made by the workers
            self._collector = _RestartingCollector(self)
        self._batches = self._collector.iterator()

    def collect(self) -> TensorDict:
        try:
            with warnings.catch_warnings():  # of weights that no scheme of TorchRL sends
                warnings.filterwarnings("ignore", "RayCollector iteration started before weight")
                return next(self._batches)
        except ray_module().exceptions.RayActorError as error:
            failures = self.problem.workers.max_restarts + 1
            raise failed_too_often(failures, error) from error

    def close(self) -> None:
        self._collector.shutdown()


class _Worker(Collector):
    """TorchRL's collector as an actor; by default Ray fails to report the errors of its methods."""

    def __bool__(self) -> bool:
        return True  # else Ray asks for the length, which an endless collector does not have

    def __repr__(self) -> str:
        return type(self).__name__  # Ray prints it with each line of output, so it has one line


class _RestartingCollector(RayCollector):
    """TorchRL's collector, with workers that Ray restarts and that receive weights as objects.

    TorchRL sends weights through a process group, which a restarted worker cannot join.
    """

    def __init__(self, collection: RayCollection) -> None:
        config, problem = collection.config, collection.problem
        self._collection = collection
        super().__init__(
            collection.make_envs(partial(_make_new_envs, problem.make_env)),
            policy_factory=collection.make_policies(),
            collector_class=_Worker,
            frames_per_batch=config.steps_per_batch * problem.num_envs // config.workers,
            total_frames=_FOREVER,
            collector_kwargs=[
                {"auto_register_policy_transforms": False} for _ in range(config.workers)
            ],
            remote_configs={
                "num_cpus": config.cpus,
                "num_gpus": config.gpus,
                "max_restarts": -1,
                "max_task_retries": problem.workers.max_restarts,  # of each batch, and of weights
            },
            weight_sync_schemes={},
            update_after_each_batch=True,
        )
        for worker in range(config.workers):
            self.update_policy_weights_(worker_ids=worker)

    def update_policy_weights_(self, *args: Any, worker_ids: int, **options: Any) -> None:
        """Send the latest weights to a worker, which takes them over before its next batch."""
        weights = ray_module().put(self._collection.weights())
        self.remote_collectors[worker_ids].cascade_execute.remote("policy.receive", weights)


def _make_new_envs(make: Callable[[int, int], EnvBase], num_envs: int, seed: int) -> EnvBase:
    """Make environments in a worker; a restarted one does not repeat its first episodes."""
    if ray_module().get_runtime_context().was_current_actor_reconstructed:
        seed = derive_seed(seed, SeedUse.COLLECTION, time.time_ns())
    return make(num_envs, seed)
