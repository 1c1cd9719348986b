"""The prioritised sampler of the replay, with a bonus for demonstrations."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.replay_buffers.samplers import PrioritizedSampler
from torchrl.data.replay_buffers.storages import Storage

from ba_torchrl import _segment_tree
from ba_torchrl.envs import keys

_segment_tree.install()  # also for a replay without environments


class ExpertPrioritizedSampler(PrioritizedSampler):
    """Prioritised sampling that prefers demonstrations (appendix G.2).

    A transition is drawn in proportion to p ^ alpha, with p = |td| + eps, plus the bonus for a
    demonstration. A new one, demonstration or not, has the largest p that an update has set so far,
    and at least one, as in Schaul et al. (2016) and the reference implementation. Each draw has the
    importance weight ``priority_weight`` = (p / p_min) ^ (-alpha beta), in (0, 1]; the loss
    normalises it over the batch.

    Args:
        max_capacity: number of transitions of the storage, over all its dimensions.
        generator: source of every draw.
        alpha: exponent of the priorities.
        beta: initial exponent of the weights; ``anneal`` raises it to one, except from zero.
        eps: added to every priority; the default is that of the reference implementation.
        expert_bonus: added to the priority of demonstrations.
        expert_key: entry with the flag of demonstrations.

    Raises:
        ValueError: an exponent or the bonus is negative, or ``eps`` is not positive.
    """

    def __init__(
        self,
        max_capacity: int,
        *,
        generator: torch.Generator,
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
        super().__init__(
            max_capacity, alpha=alpha, beta=beta, eps=eps, dtype=torch.float64, reduction="mean"
        )
        self.generator = generator
        self.expert_bonus = expert_bonus
        self.expert_key = expert_key
        self._initial_beta = beta

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
            RuntimeError: the storage is empty.
        """
        count = len(storage)
        if count == 0:
            raise RuntimeError("cannot sample from an empty replay")
        total, smallest = self._sum_tree.query(0, count), self._min_tree.query(0, count)
        mass = total * torch.rand(
            batch_size, generator=self.generator, dtype=torch.float64, device="cpu"
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
                tuple of tensors [N].
            priority: absolute TD error of each transition, or a single one for all; without the
                bonus.
            storage: storage with the expert flags, which TorchRL's buffers pass.

        Raises:
            ValueError: a priority is not finite, or the storage is missing and the bonus is not
                zero.
        """
        index = _flat_index(index, storage)
        if not index.numel():
            return
        error = torch.as_tensor(priority, dtype=self.dtype, device="cpu").detach().reshape(-1).abs()
        if not error.isfinite().all():
            raise ValueError("a TD error is not finite: the run has diverged")
        error = error.expand(index.shape)
        raw = error + self._eps + self._bonus(index, storage)
        largest = float(raw.max())
        if self._max_priority[0] is None or largest > self._max_priority[0]:
            self._max_priority = (largest, int(index[raw.argmax()]))
        self._set_leaves(index, raw)

    @torch.no_grad()
    def mark_update(
        self, index: int | Tensor | tuple[Tensor, ...], *, storage: Storage | None = None
    ) -> None:
        """Give new transitions the largest priority so far, without a further bonus.

        Args:
            index: as of `update_priority`.
            storage: as of `update_priority`; needed if it has several dimensions.
        """
        index = _flat_index(index, storage)
        largest = max(1.0, self.default_priority)
        self._set_leaves(index, torch.full(index.shape, largest, dtype=self.dtype, device="cpu"))

    def _set_leaves(self, index: Tensor, raw: Tensor) -> None:
        """Set priorities before the exponent, float64 [N], at flat indices [N]."""
        leaf = raw.pow(self.alpha)
        self._sum_tree[index] = leaf
        self._min_tree[index] = leaf

    def _bonus(self, index: Tensor, storage: Storage | None) -> Tensor | float:
        if not self.expert_bonus:
            return 0.0
        if storage is None:
            raise ValueError("update_priority needs the storage, for the expert flags")
        if hasattr(storage, "column"):  # does not decode images
            flags = storage.column(self.expert_key)[index]
        else:
            place = torch.unravel_index(index, storage.shape) if storage.ndim > 1 else index
            flags = storage[place][self.expert_key]
        return self.expert_bonus * flags.reshape(-1).to(self.dtype)

    def state_dict(self) -> dict[str, Any]:
        """Return priorities, exponents and the generator's state, as tensors and numbers."""
        everything = torch.arange(self._max_capacity, device="cpu")
        return {
            "leaves": torch.as_tensor(self._sum_tree[everything], device="cpu").reshape(-1).clone(),
            "max_priority": self._max_priority,
            "beta": self.beta,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore priorities, exponents and the generator, from any device.

        Args:
            state_dict: of a sampler of the same capacity.

        Raises:
            ValueError: the capacities differ.
        """
        leaves = state_dict["leaves"]
        if leaves.numel() != self._max_capacity:
            raise ValueError(
                f"the saved sampler has capacity {leaves.numel()}, this one {self._max_capacity}"
            )
        self._init()
        written = leaves.nonzero().reshape(-1)  # priorities of stored transitions are positive
        if written.numel():
            self._sum_tree[written] = leaves[written]
            self._min_tree[written] = leaves[written]
        largest, place = state_dict["max_priority"]
        self._max_priority = None if largest is None else (largest, place)
        self.beta = state_dict["beta"]
        self.generator.set_state(state_dict["generator"].cpu())


def _flat_index(index: int | Tensor | tuple[Tensor, ...], storage: Storage | None) -> Tensor:
    """Return indices into the flattened storage, int64 [N] on the CPU."""
    if storage is not None and storage.ndim > 1:
        if not isinstance(index, tuple):
            index = torch.as_tensor(index, device="cpu").reshape(-1, storage.ndim).unbind(-1)
        flat = torch.zeros((), dtype=torch.long, device="cpu")
        for part, size in zip(index, storage.shape, strict=True):
            flat = flat * size + torch.as_tensor(part, dtype=torch.long, device="cpu").cpu()
        return flat.reshape(-1)
    return torch.as_tensor(index, dtype=torch.long, device="cpu").cpu().reshape(-1)
