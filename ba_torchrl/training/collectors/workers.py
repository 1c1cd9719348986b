"""Collection in workers, each with a part of the environments and a copy of the policy."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from ba_torchrl.algorithms.acting import acting_keys
from ba_torchrl.core import keys
from ba_torchrl.core.seeds import SeedUse, derive_seed
from ba_torchrl.envs.faults import MAX_CONSECUTIVE_FAULTS
from ba_torchrl.training.collectors.base import Collection, CollectionProblem
from ba_torchrl.training.collectors.config import WorkersConfig

VERSION = "policy_version"
"""Key of the updates after which the policy had the weights that chose an action, int64 [1]."""
NO_WEIGHTS = -1
"""Version of a policy that has not received the learner's weights."""


class VersionedPolicy(TensorDictModuleBase):
    """A policy whose version is one of its weights, and an entry of each transition.

    Args:
        policy: from the observation to ``action``.
        first_env: number of the first of its environments, which is an entry, too.
    """

    version: Tensor

    def __init__(self, policy: TensorDictModuleBase, first_env: int = 0) -> None:
        super().__init__()
        self.policy = policy
        self.first_env = first_env
        self.register_buffer("version", torch.tensor(NO_WEIGHTS))
        self.in_keys = list(policy.in_keys)
        self.out_keys = [*acting_keys(policy), VERSION, keys.ENV_INDEX]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write action, version and numbers of the environments of a root TensorDict [envs]."""
        version = self.version.clone()  # weights that arrive during the call do not count
        out = self.policy(tensordict)
        out.set(VERSION, version.expand(*out.batch_size, 1).clone())
        numbers = self.first_env + torch.arange(out.batch_size.numel(), device=version.device)
        return out.set(keys.ENV_INDEX, numbers.reshape(out.batch_size))

    def receive(self, weights: TensorDictBase) -> None:
        """Take over the weights of another policy and their version.

        Args:
            weights: of the same structure, from `TensorDict.from_module`.
        """
        TensorDict.from_module(self).data.update_(weights)


class WorkerCollection(Collection):
    """Batches of workers whose policies have the weights of the latest update, or earlier ones.

    `scalars` holds ``restarts``, the number of times that workers were replaced, and ``lag``, the
    mean number of updates between the weights that chose the actions of the last batch and the
    batch's arrival.
    """

    def __init__(self, problem: CollectionProblem, config: WorkersConfig) -> None:
        super().__init__()
        self.problem = problem
        self.config = config
        self.policy = VersionedPolicy(problem.learner.policy)
        self.scalars = {"lag": 0.0, "restarts": 0}
        self._disturbed_in_a_row = 0
        """Number of restarts since the end of an undisturbed episode."""

    def __next__(self) -> TensorDict:
        while True:
            batch = self.collect().reshape(-1)
            version = batch.pop(VERSION)
            if (version == NO_WEIGHTS).any():  # of a worker that was replaced during the batch
                self.count_restart(RuntimeError("a worker process has ended"))
                continue
            following = batch[keys.NEXT]
            if (following[keys.DONE] & ~following[keys.FAULT]).any():
                self._disturbed_in_a_row = 0
            self.scalars["lag"] = (self.problem.learner.updates - version).float().mean().item()
            return batch

    @abstractmethod
    def collect(self) -> TensorDict:
        """Send the weights of `policy`, and return the transitions of one batch."""

    def count_restart(self, cause: Exception) -> None:
        """Count the replacement of workers after a failure.

        Raises:
            RuntimeError: there were too many without an undisturbed episode in between.
        """
        self.scalars["restarts"] += 1
        self._disturbed_in_a_row += 1
        limit = max(self.problem.workers.max_restarts + 1, MAX_CONSECUTIVE_FAULTS)
        if self._disturbed_in_a_row >= limit:
            raise failed_too_often(self._disturbed_in_a_row, cause) from cause

    def weights(self) -> TensorDict:
        """Return a copy of the weights and their version, on the CPU."""
        self.policy.version.fill_(self.problem.learner.updates)
        return TensorDict.from_module(self.policy).data.to("cpu").clone()

    def make_envs(
        self, make: Callable[[int, int], EnvBase], attempt: int = 0
    ) -> list[Callable[[], EnvBase]]:
        """Return the functions that make the environments of each worker.

        Args:
            make: from a number of environments and the seed of the first to the environments.
            attempt: number of times that the workers were replaced; each has other seeds.
        """
        count = self.problem.num_envs // self.config.workers
        seed = self._seed(attempt)
        return [
            partial(make, count, seed + worker * count) for worker in range(self.config.workers)
        ]

    def make_policies(self, attempt: int = 0) -> list[Callable[[], VersionedPolicy]]:
        """Return the functions that make the policy of each worker; see `make_envs`.

        The workers draw different random numbers. They receive the weights before the first step.
        """
        seed = derive_seed(self._seed(attempt), SeedUse.EXPLORATION)
        count = self.problem.num_envs // self.config.workers
        return [
            partial(
                _make_policy,
                self.problem.make_policy,
                derive_seed(seed, SeedUse.EXPLORATION, worker),
                worker * count,
            )
            for worker in range(self.config.workers)
        ]

    def _seed(self, attempt: int) -> int:
        seed = self.problem.seed
        return seed if attempt == 0 else derive_seed(seed, SeedUse.COLLECTION, attempt)


def failed_too_often(failures: int, cause: Exception) -> RuntimeError:
    """Return the error of workers that failed too often in a row; see `WorkerOptions`."""
    return RuntimeError(
        f"the collector's workers failed {failures} times in a row; the last time: {cause}. Raise "
        "max_restarts, or use collector=single to see the error where it happens"
    )


def _make_policy(
    make: Callable[[int], TensorDictModuleBase], seed: int, first_env: int
) -> VersionedPolicy:
    return VersionedPolicy(make(seed), first_env)
