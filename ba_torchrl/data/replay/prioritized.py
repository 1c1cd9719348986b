"""The prioritised sampler of the replay, with a bonus for demonstrations."""

from __future__ import annotations

import logging
import math
from typing import Any

import numpy as np
import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl import torchrl_logger
from torchrl.data.replay_buffers.samplers import (
    MinSegmentTreeFp64,
    PrioritizedSampler,
    SumSegmentTreeFp64,
)
from torchrl.data.replay_buffers.storages import Storage

from ba_torchrl.core import keys
from ba_torchrl.core.files import StateFolder
from ba_torchrl.data.replay.segment_tree import MinTree, SumTree
from ba_torchrl.data.replay.storage import OneProcess, stored_flags


class ExpertPrioritizedSampler(OneProcess, StateFolder, PrioritizedSampler):
    """Prioritised sampling that prefers demonstrations (appendix G.2).

    A transition is drawn in proportion to p ^ alpha, with ``p = |td| + eps``, plus the bonus for a
    demonstration. A new one, demonstration or not, has the largest p that an update has set so far,
    and at least one, as in Schaul et al. (2016) and the reference implementation. Each draw has the
    importance weight ``priority_weight`` = (p / p_min) ^ (-alpha beta), in (0, 1]; the loss
    normalises it over the batch. The source of the draws is the ``generator`` of the buffer.

    Args:
        max_capacity: number of transitions of the storage, over all its dimensions.
        alpha: exponent of the priorities.
        beta: initial exponent of the weights; ``anneal`` raises it to one, except from zero.
        eps: added to every priority; the default is that of the reference implementation.
        expert_bonus: added to the priority of demonstrations.
        expert_key: entry with the flag of demonstrations.

    Raises:
        ValueError: an exponent or the bonus is negative, or ``eps`` is not positive.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from ba_torchrl.data import ExpertPrioritizedSampler
        >>> storage, sampler = LazyTensorStorage(100), ExpertPrioritizedSampler(100, beta=0.4)
        >>> replay = TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=8)
        >>> steps = {"observation": torch.rand(20, 3), "is_demonstration": torch.arange(20) < 5}
        >>> steps = TensorDict(steps, [20])
        >>> replay.extend(steps).shape
        torch.Size([20])
        >>> batch = replay.sample()
        >>> batch["priority_weight"].shape
        torch.Size([8])
        >>> replay.update_tensordict_priority(batch.set("td_error", torch.rand(8)))
    """

    def __init__(
        self,
        max_capacity: int,
        *,
        alpha: float = 0.6,
        beta: float = 0.4,
        eps: float = 1e-6,
        expert_bonus: float = 1.0,
        expert_key: NestedKey = keys.IS_DEMONSTRATION,
    ) -> None:
        if eps <= 0 or expert_bonus < 0:
            raise ValueError(
                f"eps must be positive and expert_bonus not negative, got {eps}, {expert_bonus}"
            )
        torchrl_logger.addFilter(_refuse)  # of native trees that did not load
        try:
            super().__init__(
                max_capacity,
                alpha=alpha,
                beta=beta,
                eps=0.0,  # TorchRL would add it to the largest p again
                dtype=torch.float64,
                reduction="mean",
                device="cpu",
            )
        finally:
            torchrl_logger.removeFilter(_refuse)
        self.eps = eps
        self.expert_bonus = expert_bonus
        self.expert_key = expert_key
        self._initial_beta = beta

    def _init(self) -> None:
        """Make empty trees: TorchRL's native ones, or NumPy's if they did not load."""
        self._sum_tree = (SumSegmentTreeFp64 or SumTree)(self.max_size)
        self._min_tree = (MinSegmentTreeFp64 or MinTree)(self.max_size)
        self._largest = 1.0
        """The largest priority so far, of which the first transitions have one."""

    @property
    def default_priority(self) -> float:
        """Minus infinity, for which `update_priority` sets the largest priority so far. TorchRL's
        buffers pass it for transitions without a TD error, in tensors of several types."""
        return -math.inf

    def __repr__(self) -> str:
        names = ("alpha", "beta", "eps", "expert_bonus")
        values = ", ".join(f"{name}={getattr(self, name)}" for name in names)
        return f"{type(self).__name__}({values})"

    def anneal(self, fraction: float) -> None:
        """Interpolate beta between its initial value and one; an initial value of zero is kept.

        Args:
            fraction: elapsed fraction of the run; clipped to [0, 1].
        """
        if not self._initial_beta:
            return
        fraction = min(max(fraction, 0.0), 1.0)
        self.beta = self._initial_beta + (1.0 - self._initial_beta) * fraction

    def sample(
        self, storage: Storage, batch_size: int
    ) -> tuple[Tensor | tuple[Tensor, ...], dict[str, Tensor]]:
        """Return ``batch_size`` indices drawn by priority, and their ``priority_weight`` [B].

        Args:
            storage: the storage that is sampled.
            batch_size: number of draws, with replacement.

        Returns:
            Indices [B], or for a storage of several dimensions a tuple of them; and the weights.

        Raises:
            RuntimeError: the storage is empty, or its transitions have no priorities.
        """
        count = len(storage)
        if count == 0:
            raise RuntimeError("cannot sample from an empty replay")
        total, smallest = self._sum_tree.query(0, count), self._min_tree.query(0, count)
        if total <= 0:
            raise RuntimeError(
                "the stored transitions have no priorities: pass the sampler when the buffer is "
                "constructed, not to set_sampler"
            )
        mass = total * torch.rand(
            batch_size, generator=self._rng, dtype=torch.float64, device="cpu"
        )
        # native trees return a number for a single draw
        index = torch.as_tensor(self._sum_tree.scan_lower_bound(mass), device="cpu")
        index = index.long().reshape(-1).clamp_max(count - 1)  # rounding of the total
        leaf = torch.as_tensor(self._sum_tree[index], device="cpu").reshape(-1)
        weights = {"priority_weight": (leaf / smallest).pow(-self.beta).float()}
        return (torch.unravel_index(index, storage.shape) if storage.ndim > 1 else index), weights

    @torch.no_grad()
    def update_priority(
        self,
        index: int | Tensor | tuple[Tensor, ...],
        priority: float | Tensor,
        *,
        storage: Storage | None = None,
    ) -> None:
        """Set the priorities of some transitions.

        Args:
            index: of the transitions: [N], or for a storage of several dimensions [N, ndim] or a
                tuple of tensors [N]. A negative one is that of a transition that is not stored.
            priority: absolute TD error of each transition, or a single one for all; without the
                bonus. Only `default_priority`: as `mark_update`.
            storage: storage with the expert flags, which TorchRL's buffers pass.

        Raises:
            ValueError: a priority is not finite, there are not as many as indices, an index is
                beyond ``max_capacity``, or the storage is missing and the bonus is not zero.
        """
        index = torch.stack(index, -1) if isinstance(index, tuple) else index
        index = torch.as_tensor(index, dtype=torch.long, device="cpu")
        if index.ndim > 1:
            index = torch.from_numpy(np.ravel_multi_index(index.unbind(-1), storage.shape))
        index = index.reshape(-1)
        error = torch.as_tensor(priority, dtype=self.dtype, device="cpu").reshape(-1)
        if (error == self.default_priority).all():
            return self.mark_update(index)
        if not error.isfinite().all():
            raise ValueError(
                "a TD error is not finite: the run has diverged, or the batch has a reward, an "
                "action or an image that is not finite"
            )
        if error.numel() not in (1, index.numel()):
            raise ValueError(f"{error.numel()} priorities for {index.numel()} indices")
        is_stored = index >= 0
        index, error = index[is_stored], error.abs().expand(index.shape)[is_stored]
        if len(index):
            self._set(index, error + self.eps + self._bonus(index, storage))

    @torch.no_grad()
    def mark_update(self, index: int | Tensor, *, storage: Storage | None = None) -> None:
        """Give new transitions the largest priority so far, without a further bonus.

        Args:
            index: as of `update_priority`.
            storage: as of `update_priority`; needed if it has several dimensions.
        """
        largest = torch.tensor(self._largest, dtype=self.dtype, device="cpu")
        self._set(index, largest, storage)

    def _set(self, index: Any, priority: Tensor, storage: Storage | None = None) -> None:
        if (torch.as_tensor(index, device="cpu") >= self.max_size).any():
            raise ValueError(
                f"the storage holds more than max_capacity={self.max_size} transitions: give "
                "the sampler the capacity of the storage"
            )
        super().update_priority(index, priority, storage=storage)
        self._largest = max(self._largest, float(priority.max()))

    def _bonus(self, index: Tensor, storage: Storage | None) -> Tensor | float:
        if not self.expert_bonus:
            return 0.0
        if storage is None:
            raise ValueError("update_priority needs the storage, for the expert flags")
        return self.expert_bonus * stored_flags(storage, self.expert_key, index).to(self.dtype)

    def state_dict(self) -> dict[str, Any]:
        """Return priorities and exponents, as tensors and numbers."""
        everything = torch.arange(self.max_size, device="cpu")
        return {
            "leaves": torch.as_tensor(self._sum_tree[everything], device="cpu").reshape(-1).clone(),
            "max_priority": (self._largest, None),  # and TorchRL's index of it, which nothing reads
            "alpha": self.alpha,
            "beta": self.beta,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore priorities and exponents, from any device.

        Args:
            state_dict: of a sampler of the same capacity.

        Raises:
            ValueError: the capacities differ.
        """
        leaves = state_dict["leaves"]
        if leaves.numel() != self.max_size:
            raise ValueError(
                f"the saved sampler has capacity {leaves.numel()}, this one {self.max_size}"
            )
        self._init()
        # before the leaves, which the property would transform; saved runs may lack the entry
        self.alpha = state_dict.get("alpha", self.alpha)
        written = leaves.nonzero().reshape(-1)  # priorities of stored transitions are positive
        if written.numel():
            self._sum_tree[written] = leaves[written]
            self._min_tree[written] = leaves[written]
        self._largest = state_dict["max_priority"][0] or 1.0
        self.beta = state_dict["beta"]


def _refuse(record: logging.LogRecord) -> bool:
    return False
