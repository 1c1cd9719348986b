"""Gymnasium's ids of the tasks, registered in whatever order things are imported.

Gymnasium no longer looks for entry points, so importing this package registers the ids. That must
stay cheap for those who never use Gymnasium: the tasks are imported when Gymnasium is. A task that
registers later, from a module outside the package, gets its id at that moment.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from ba_torchrl.plugins import MAIN
from ba_torchrl.registry import call_on_registration

NAMESPACE = "BulletArm"
ENTRY_POINT = "ba_torchrl.envs.gym:GymEnv"


def gym_id(task: str) -> str:
    """Return Gymnasium's id of a task.

    ``close_loop/block_picking`` is ``BulletArm/CloseLoopBlockPicking-v0``; ``mine/push_far``, from
    outside the package, is ``BulletArm/MinePushFar-v0``.
    """
    words = task.replace("/", "_").split("_")
    return f"{NAMESPACE}/{''.join(word.capitalize() for word in words)}-v0"


def register_task(task: str) -> None:
    """Register one task with Gymnasium, unless it is registered; torch is not imported.

    The step limit is not registered: it is ``max_steps`` of the configuration, and the
    environment itself truncates the episode there. A task from outside the package is registered
    with its module, which processes of ``gymnasium.make_vec`` import.

    Raises:
        ValueError: another task has the same id.
    """
    from gymnasium.envs.registration import register, registry

    from ba_torchrl.tasks.base import TASKS

    name = gym_id(task)
    if name in registry:
        other = registry[name].kwargs.get("task")
        if other != task:
            raise ValueError(f"the tasks {other!r} and {task!r} have the same Gymnasium id, {name}")
        return
    kwargs: dict[str, Any] = {"task": task}
    module = TASKS.plugin_module(task)
    if module is not None and module not in MAIN:
        kwargs["register_modules"] = (module,)
    register(name, entry_point=ENTRY_POINT, kwargs=kwargs)


def register_tasks() -> None:
    """Register every task that Gymnasium does not know yet."""
    from ba_torchrl.tasks.base import TASKS

    for task in TASKS:
        register_task(task)


def register_with_gymnasium() -> None:
    """Register the tasks if Gymnasium is imported, else as soon as it is, and later ones then."""
    call_on_registration("task", _register_if_imported)
    if "gymnasium" in sys.modules:
        register_tasks()
    else:
        sys.meta_path.insert(0, _RegisterOnImport())


def _register_if_imported(task: str) -> None:
    if hasattr(sys.modules.get("gymnasium"), "register"):  # else all tasks follow its import
        register_task(task)


class _RegisterOnImport(MetaPathFinder):
    """Registers the tasks when Gymnasium, which the other finders find, has been imported."""

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
