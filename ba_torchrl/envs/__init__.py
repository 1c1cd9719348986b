"""TorchRL environments."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ba_torchrl.envs import keys
    from ba_torchrl.envs.base import BulletArmEnv
    from ba_torchrl.envs.images import ImageSpec

_MODULES = {"ImageSpec": "images", "BulletArmEnv": "base"}
"""Modules of the names, imported at their first use: that of TorchRL takes seconds."""

__all__ = ["BulletArmEnv", "ImageSpec", "keys"]


def __getattr__(name: str) -> Any:
    if name == "keys":
        return importlib.import_module(f"{__name__}.keys")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
