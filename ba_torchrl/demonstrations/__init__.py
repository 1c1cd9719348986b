"""Demonstrations: of experts, of people and in files, their own and those of other libraries."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ba_torchrl.core.lazy import lazy_names

if TYPE_CHECKING:
    from ba_torchrl.demonstrations.collect import (
        collect_demonstrations as collect_demonstrations,
        expert_scores as expert_scores,
    )
    from ba_torchrl.demonstrations.dataset import (
        BulletArmExperienceReplay as BulletArmExperienceReplay,
    )
    from ba_torchrl.demonstrations.demo_files import (
        load_demonstrations as load_demonstrations,
        save_demonstrations as save_demonstrations,
    )
    from ba_torchrl.demonstrations.episodes import (
        collect_episodes as collect_episodes,
        mean_length as mean_length,
        success_rate as success_rate,
    )
    from ba_torchrl.demonstrations.exchange import export_demonstrations as export_demonstrations
    from ba_torchrl.envs.policies import expert_policy as expert_policy


__getattr__, __dir__, __all__ = lazy_names(__name__)
