"""Marks of tensors: a digest of the bits, and the numbers or their sum."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

VALUES = 16
"""Tensors of at most this many elements are recorded as numbers, larger ones as their sum."""


def digest(*arrays: np.ndarray) -> str:
    """Return the first 64 bits of the SHA-256 of arrays, their types and shapes, in hexadecimal."""
    total = hashlib.sha256()
    for array in arrays:
        total.update(f"{array.dtype}{array.shape}".encode())
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()[:16]


def mark(value: torch.Tensor | np.ndarray | float) -> list[Any]:
    """Return the digest of a value, and its numbers or their sum."""
    array = np.asarray(value.detach().cpu() if isinstance(value, torch.Tensor) else value)
    if array.size <= VALUES:
        return [digest(array), [float(x) for x in array.flatten()]]
    return [digest(array), float(array.sum(dtype=np.float64))]


def marks(data: TensorDictBase) -> dict[str, list[Any]]:
    """Return the marks of all entries except those under "next"."""
    return {
        ".".join(key) if isinstance(key, tuple) else key: mark(data[key])
        for key in sorted(data.keys(include_nested=True, leaves_only=True), key=str)
        if key[0] != "next"
    }


def spec_facts(env: EnvBase) -> dict[str, str]:
    """Return type, shape and bounds of every entry of an environment's specifications."""

    def describe(spec: TensorSpec) -> str:
        text = f"{type(spec).__name__} {spec.dtype} {tuple(spec.shape)}"
        bounds = [getattr(spec.space, name, None) for name in ("low", "high")]
        if all(isinstance(bound, torch.Tensor) for bound in bounds):
            text += f" {digest(*(bound.numpy() for bound in bounds))}"
            text += f" {float(bounds[0].min()):g} to {float(bounds[1].max()):g}"
        return text

    groups = {
        "observation": env.full_observation_spec,
        "action": env.full_action_spec,
        "reward": env.full_reward_spec,
        "done": env.full_done_spec,
    }
    return {
        f"spec {group} {key}": describe(spec)
        for group, composite in groups.items()
        for key, spec in composite.items(include_nested=True, leaves_only=True)
    }


def tensors(state: Any) -> Iterator[torch.Tensor]:
    """Return the tensors in nested containers."""
    if isinstance(state, torch.Tensor):
        yield state
    elif isinstance(state, dict):
        for value in state.values():
            yield from tensors(value)
    elif isinstance(state, list | tuple):
        for value in state:
            yield from tensors(value)


def tensors_mark(state: Any) -> str:
    """Return the digest of a set of tensors, independent of their names and order."""
    arrays = [tensor.detach().cpu().numpy() for tensor in tensors(state)]
    digests = "".join(sorted(digest(array) for array in arrays))
    total = sum(float(np.abs(array.astype(np.float64)).sum()) for array in arrays)
    return (
        f"{hashlib.sha256(digests.encode()).hexdigest()[:16]}, {len(arrays)} tensors, "
        f"sum of magnitudes {total:.12g}"
    )
