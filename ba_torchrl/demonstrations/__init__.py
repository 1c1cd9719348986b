"""Demonstrations: of experts, of people and in files, their own and those of other libraries."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ba_torchrl.core.lazy import lazy_names

if TYPE_CHECKING:
    from ba_torchrl.demonstrations.collect import collect_demonstrations, expert_scores
    from ba_torchrl.demonstrations.dataset import BulletArmExperienceReplay
    from ba_torchrl.demonstrations.demo_files import load_demonstrations, save_demonstrations
    from ba_torchrl.demonstrations.episodes import collect_episodes, mean_length, success_rate
    from ba_torchrl.demonstrations.exchange import export_demonstrations
    from ba_torchrl.envs.policies import expert_policy

_MODULES = {
    "BulletArmExperienceReplay": "dataset",
    "collect_demonstrations": "collect",
    "collect_episodes": "episodes",
    "expert_policy": "collect",
    "expert_scores": "collect",
    "export_demonstrations": "exchange",
    "load_demonstrations": "demo_files",
    "mean_length": "episodes",
    "save_demonstrations": "demo_files",
    "success_rate": "episodes",
}
"""Modules of the names, imported at their first use: files and formats need no torch."""

__all__ = [
    "BulletArmExperienceReplay",
    "collect_demonstrations",
    "collect_episodes",
    "expert_policy",
    "expert_scores",
    "export_demonstrations",
    "load_demonstrations",
    "mean_length",
    "save_demonstrations",
    "success_rate",
]

__getattr__, __dir__ = lazy_names(__name__, _MODULES, __all__)
