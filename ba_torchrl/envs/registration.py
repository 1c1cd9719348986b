"""Registration of the tasks with Gymnasium, in any order of imports.

Gymnasium does not load entry points, so the import of this package registers the ids. To keep that
import fast, the tasks are imported only when Gymnasium is. A task that registers later, from a
module outside the package, gets its id at that time.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, NamedTuple

from ba_torchrl.core.plugins import MAIN
from ba_torchrl.core.registry import call_on_registration

NAMESPACE = "BulletArm"
STEP_LIMIT = "ba_torchrl.envs.gym:StepLimit"


class Variant(NamedTuple):
    """A kind of id.

    Args:
        entry_point: of its environments.
        kwargs: keywords that they have by default.
    """

    entry_point: str
    kwargs: dict[str, Any]


VARIANTS = {
    "": Variant("ba_torchrl.envs.gym:GymEnv", {}),
    "State": Variant("ba_torchrl.envs.gym:StateEnv", {"obs_type": "vec"}),
    "StateDense": Variant("ba_torchrl.envs.gym:StateEnv", {"obs_type": "vec", "reward": "dense"}),
    "Goal": Variant("ba_torchrl.envs.goals:GoalEnv", {"obs_type": "vec"}),
}
"""By the ending of an id's name."""


def variants_of(task: str) -> dict[str, Variant]:
    """Return the `VARIANTS` of a registered task.

    Without `progress` it has no dense rewards, without `goal_vectors` no goals.
    """
    from ba_torchrl.tasks.base import TASKS, Task

    entry = TASKS.entry(task)
    missing = {"StateDense"} if entry.progress is Task.progress else set()
    missing |= {"Goal"} if entry.goal_vectors is None else set()
    return {name: variant for name, variant in VARIANTS.items() if name not in missing}


def gym_id(task: str, variant: str = "") -> str:
    """Return Gymnasium's id of a registered task, which ends in its version.

    The id of ``close_loop/block_picking`` is ``BulletArm/CloseLoopBlockPicking-v0``; the id of
    ``mine/push_far``, a task from outside the package, is ``BulletArm/MinePushFar-v0``.

    Args:
        task: as listed by `ba_torchrl.list_tasks`.
        variant: one of `VARIANTS`: ``State`` for ``BulletArm/CloseLoopBlockPicking-State-v0``.
    """
    from ba_torchrl.tasks.base import versions_of

    words = task.replace("/", "_").split("_")
    name = "".join(word.capitalize() for word in words)
    ending = f"-{variant}" if variant else ""
    return f"{NAMESPACE}/{name}{ending}-v{versions_of(task).task}"


def register_task(task: str) -> None:
    """Register a task's variants with Gymnasium, unless they are there, without importing torch.

    No step limit is registered, because the environment truncates the episode at ``max_steps`` of
    its configuration. A task from outside the package is registered with its module, which the
    processes of ``gymnasium.make_vec`` import.
    """
    from gymnasium.envs.registration import WrapperSpec, register, registry

    from ba_torchrl.tasks.base import TASKS

    module = TASKS.plugin_module(task)
    for ending, variant in variants_of(task).items():
        name = gym_id(task, ending)
        if name in registry:
            other = registry[name].kwargs.get("task")
            if other != task:
                raise ValueError(
                    f"the tasks {other!r} and {task!r} have the same Gymnasium id, {name}"
                )
            continue
        kwargs: dict[str, Any] = {"task": task, **variant.kwargs}
        if module is not None and module not in MAIN:
            kwargs["register_modules"] = (module,)
        wrappers = (WrapperSpec("StepLimit", STEP_LIMIT, {}),) if ending else ()
        register(
            name,
            entry_point=variant.entry_point,
            additional_wrappers=wrappers,
            kwargs=kwargs,
        )


def register_tasks() -> None:
    """Register every task that is not registered with Gymnasium yet."""
    from ba_torchrl.tasks.base import TASKS

    for task in TASKS:
        register_task(task)


def register_with_gymnasium() -> None:
    """Register all present and future tasks, once Gymnasium is imported."""
    call_on_registration("task", _register_if_imported)
    if "gymnasium" in sys.modules:
        register_tasks()
    else:
        sys.meta_path.insert(0, _RegisterOnImport())


def _register_if_imported(task: str) -> None:
    # Otherwise the import of Gymnasium registers all tasks.
    if hasattr(sys.modules.get("gymnasium"), "register"):
        register_task(task)


class _RegisterOnImport(MetaPathFinder):
    """An import hook that registers the tasks after the import of Gymnasium."""

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
            # Not in find_spec, which is also called to test whether a module exists.
            sys.meta_path.remove(self)
            register_tasks()

        spec.loader.exec_module = load_and_register
        return spec
