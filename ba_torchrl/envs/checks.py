"""Validation of actions and seeds before they are used, of policies, and of what is observed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, NonTensor, TensorSpec
from torchrl.envs import EnvBase

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError, InvalidActionError


class ChecksPolicy:
    """Mix-in of environments: ``rollout`` lets a trained policy check the environment first."""

    def rollout(
        self, max_steps: int, policy: Any = None, *args: Any, **kwargs: Any
    ) -> TensorDictBase:
        """Play at most ``max_steps`` steps; see `EnvBase.rollout`."""
        check_policy(policy, self)
        return super().rollout(max_steps, policy, *args, **kwargs)


def check_policy(policy: Any, env: EnvBase) -> None:
    """Let a policy with the method ``check_env``, such as `TrainedPolicy`, check an environment."""
    if hasattr(policy, "check_env"):
        policy.check_env(env)


def check_seed(seed: int) -> None:
    """Check that a seed is a natural number."""
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
        raise ValueError(f"a seed must be a natural number, got {seed!r}")


def check_entries(observation: Mapping[str, Any], specs: Composite) -> None:
    """Check that the entries of an observation have the keys, types and shapes of ``specs``."""
    specified = set(specs.keys()) - {keys.SUCCESS, keys.FAULT, keys.STEP_COUNT}
    if specified != observation.keys():
        raise ConfigError(
            f"observations: {', '.join(sorted(specified ^ observation.keys()))} is either observed "
            "or specified, not both"
        )
    for key, value in observation.items():
        spec = specs[key]
        if isinstance(spec, NonTensor):
            continue
        found = (getattr(value, "dtype", type(value)), tuple(getattr(value, "shape", ())))
        if found != (spec.dtype, tuple(spec.shape)):
            raise ConfigError(
                f"observations: {key} has {found[0]} {list(found[1])}, its specification "
                f"{spec.dtype} {list(spec.shape)}"
            )


def checked_action(action: torch.Tensor | None, task_id: str, action_sequence: str) -> np.ndarray:
    """Return the action of one environment as an array [A] float32.

    Args:
        action: [A] float32; values beyond its bounds are allowed, the environment clips them.
        action_sequence: one letter per component.
    """
    size = len(action_sequence)
    if action is None:
        raise InvalidActionError(f"the input has no {keys.ACTION!r}: write it before step()")
    if action.shape != (size,) or action.dtype != torch.float32:
        raise InvalidActionError(
            f"{task_id} takes a float32 action of shape ({size},), one component per letter of "
            f"{action_sequence!r}; got {action.dtype} of shape {tuple(action.shape)}"
        )
    array = action.detach().cpu().numpy()
    if not np.isfinite(array).all():
        raise InvalidActionError(f"the action is not finite: {array.tolist()}")
    return array


def check_actions(
    actions: torch.Tensor | None, spec: TensorSpec, stepped: torch.Tensor | None = None
) -> None:
    """Check that actions are present, finite and of the right shape and type.

    Args:
        actions: [n, A], one row per environment.
        spec: of ``actions``; values out of its bounds are allowed, the environments clip them.
        stepped: [n] or [n, 1] bool, the environments that step; None for all.
    """
    if actions is None:
        raise InvalidActionError(
            f"there is no action; every environment needs {_describe(spec[0])}"
        )
    same_layout = actions.shape == spec.shape and actions.dtype == spec.dtype
    if same_layout and bool(torch.isfinite(actions).all()):
        return
    if actions.shape[:1] != spec.shape[:1]:
        raise InvalidActionError(
            f"the actions have shape {list(actions.shape)}, and there are {spec.shape[0]} "
            f"environments; each needs {_describe(spec[0])}"
        )
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
