"""TorchRL environments."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ba_torchrl.core.lazy import lazy_names

if TYPE_CHECKING:
    from ba_torchrl.envs.base import BulletArmEnv as BulletArmEnv


__getattr__, __dir__, __all__ = lazy_names(__name__)
