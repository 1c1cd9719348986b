"""Gymnasium's ids of the tasks, known wherever both packages are imported, in either order.

Gymnasium no longer looks for entry points, so importing this package has to do. That must stay
cheap for those who never use Gymnasium: the tasks are looked up when it is there, not before.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

NAMESPACE = "BulletArm"
ENTRY_POINT = "ba_torchrl.envs.gym:GymEnv"


def gym_id(task: str) -> str:
    """Return Gymnasium's id of a task: ``BulletArm/CloseLoopBlockPicking-v0`` and the like."""
    words = task.replace("/", "_").split("_")
    return f"{NAMESPACE}/{''.join(word.capitalize() for word in words)}-v0"


def register_tasks() -> None:
    """Register every task that Gymnasium does not know yet; neither torch nor a world is loaded.

    The step limit is not registered: it is ``max_steps`` of the configuration, and the
    environment itself truncates the episode there.
    """
    from gymnasium.envs.registration import register, registry

    from ba_torchrl.tasks.base import TASKS

    for task in TASKS:
        if gym_id(task) not in registry:
            register(gym_id(task), entry_point=ENTRY_POINT, kwargs={"task": task})


def register_with_gymnasium() -> None:
    """Register the tasks now if Gymnasium is imported, else as soon as it is."""
    if "gymnasium" in sys.modules:
        register_tasks()
    else:
        sys.meta_path.insert(0, _RegisterOnImport())


class _RegisterOnImport(MetaPathFinder):
    """Has Gymnasium found by the other finders, and the tasks registered once it is loaded."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        specs = (finder.find_spec(fullname, path, target) for finder in others)
        spec = next((spec for spec in specs if spec is not None), None)
        if spec is None or spec.loader is None:
            return spec
        load = spec.loader.exec_module

        def load_and_register(module: ModuleType) -> None:
            load(module)
            # Only now: others look for a module to see whether it is there, and never load it.
            sys.meta_path.remove(self)
            register_tasks()

        spec.loader.exec_module = load_and_register
        return spec
