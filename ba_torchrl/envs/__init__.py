"""TorchRL environments."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ba_torchrl._lazy import lazy_names
from ba_torchrl.envs import keys

if TYPE_CHECKING:
    from ba_torchrl.envs.base import BulletArmEnv
    from ba_torchrl.envs.images import ImageSpec

_MODULES = {"ImageSpec": "images", "BulletArmEnv": "base"}
"""Modules of the names, imported at their first use: that of TorchRL takes seconds."""

__all__ = ["BulletArmEnv", "ImageSpec", "keys"]

__getattr__, __dir__ = lazy_names(__name__, _MODULES, __all__)
