"""What chooses the actions of an environment."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError

Policy = Callable[[TensorDictBase], TensorDictBase]
"""Writes ``action`` into a root TensorDict of any batch shape and returns it."""


def expert_policy(tensordict: TensorDictBase) -> TensorDictBase:
    """Copy the expert's action; the environment must be made with ``expert=True``."""
    if keys.EXPERT_ACTION not in tensordict:
        raise ConfigError("there is no expert's action: make the environment with expert=True")
    return tensordict.set(keys.ACTION, tensordict[keys.EXPERT_ACTION].clone())
