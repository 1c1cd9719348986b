"""Seeding and validation of actions, common to all vectors of environments."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, SupportsIndex

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import ParallelEnv
from typing_extensions import Self

from ba_torchrl.envs.checks import ChecksPolicy, check_actions
from ba_torchrl.envs.positions import Position


class SeededVector(ChecksPolicy):
    """Mix-in of both vectors: seeds of the environments, validation of actions and policies."""

    _base_seed: int | None = None

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int:
        """Seed environment i with ``seed + i``; return the seed for the next vector.

        Raises:
            ValueError: ``seed`` is not a natural number.
        """
        self._set_base_seed(seed)
        if self.is_closed:
            self.start()
        for index in range(self.num_workers):
            self._seed_env(index, seed + index)
        return seed if static_seed else seed + self.num_workers

    def get_positions(self) -> list[Position]:
        """Return the position of each environment in its episodes; see `RecordedPosition`.

        Raises:
            WorkerError: a worker has failed.
            SimulationError: the environments were not reset.
        """
        raise NotImplementedError

    def continue_from(self, positions: Sequence[Position]) -> None:
        """Continue the episodes of `get_positions`; the next reset returns their observations.

        Args:
            positions: of as many environments of the same task and parameters.

        Raises:
            WorkerError: a worker has failed.
        """
        raise NotImplementedError

    def __copy__(self) -> Self:
        return copy.deepcopy(self)  # both would step the same environments

    def __reduce_ex__(self, protocol: SupportsIndex) -> tuple[Any, ...]:
        if isinstance(self, ParallelEnv) and not self.is_closed:  # TorchRL would close it
            raise TypeError(
                "the processes of a vector cannot be copied: copy one with parallel=False, let "
                "another vector continue the episodes, other.continue_from(envs.get_positions()), "
                "or use get_state and set_state of a single environment"
            )
        return super().__reduce_ex__(protocol)

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, seed: int | None = None, **kwargs: Any
    ) -> TensorDictBase:
        if seed is not None:
            self._set_base_seed(seed)
            each = kwargs.pop("list_of_kwargs", [{}] * self.num_workers)
            each = [{**kwargs, **own, "seed": seed + i} for i, own in enumerate(each)]
            kwargs = {"list_of_kwargs": each}
        return super()._reset(tensordict, **kwargs)

    def _check_actions(self, tensordict: TensorDictBase) -> None:
        check_actions(
            tensordict.get(self.action_key, None), self.action_spec, tensordict.get("_step", None)
        )

    def _set_base_seed(self, seed: int | None) -> None:
        if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
            raise ValueError(f"a seed must be a natural number, got {seed!r}")
        self._base_seed = int(seed)

    def _seed_env(self, index: int, seed: int) -> None:
        raise NotImplementedError
