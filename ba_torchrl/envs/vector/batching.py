"""Seeds and checks of actions, common to all vectors of environments."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import TensorSpec

from ba_torchrl.errors import InvalidActionError


def check_actions(
    actions: torch.Tensor | None, spec: TensorSpec, stepped: torch.Tensor | None = None
) -> None:
    """Refuse actions that are missing, not finite or of the wrong shape or type.

    Args:
        actions: [n, A], one row per environment.
        spec: of ``actions``; values out of its bounds are allowed, the environments clip them.
        stepped: [n] or [n, 1] bool, the environments that are about to step; None means all.

    Raises:
        InvalidActionError: an action is missing, not finite, or not shaped and typed like ``spec``.
    """
    if actions is None:
        raise InvalidActionError(
            f"there is no action; every environment needs {_describe(spec[0])}"
        )
    same_layout = actions.shape == spec.shape and actions.dtype == spec.dtype
    if same_layout and bool(torch.isfinite(actions).all()):
        return
    for index, action in enumerate(actions.unbind(0)):
        if stepped is not None and not bool(stepped[index].any()):
            continue
        allowed = spec[index]
        if action.shape != allowed.shape:
            problem = f"has shape {list(action.shape)}"
        elif action.dtype != allowed.dtype:
            problem = f"has type {action.dtype}"
        elif bool(torch.isnan(action).any()):
            problem = f"holds NaN: {action.tolist()}"
        elif not bool(torch.isfinite(action).all()):
            problem = f"holds an infinite value: {action.tolist()}"
        else:
            continue
        raise InvalidActionError(
            f"the action of environment {index} {problem}; allowed is {_describe(allowed)}. "
            "Nothing has moved."
        )


def _describe(spec: TensorSpec) -> str:
    """Return a description of the actions that ``spec`` allows."""
    low, high = getattr(spec.space, "low", None), getattr(spec.space, "high", None)
    bounds = "" if low is None else f", from {low.tolist()} to {high.tolist()}"
    return f"a finite {spec.dtype} tensor of shape {list(spec.shape)}{bounds}"


class SeededVector:
    """Mix-in of both kinds of vectors: seeds of the environments and the check of actions."""

    _base_seed: int | None = None

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int:
        """Seed environment i with ``seed + i``; return a seed for the next vector.

        Raises:
            ValueError: ``seed`` is not a natural number.
        """
        self._set_base_seed(seed)
        if self.is_closed:
            self.start()
        for index in range(self.num_workers):
            self._seed_env(index, seed + index)
        return seed if static_seed else seed + self.num_workers

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
