"""Construction of environments from task ids."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from types import ModuleType
from typing import Any

from torchrl.envs import EnvBase

from ba_torchrl.config import EnvConfig
from ba_torchrl.envs.base import CONTROLS, ManipulationEnv
from ba_torchrl.envs.copying import registering_modules
from ba_torchrl.envs.settings import parse_env_config
from ba_torchrl.envs.vector.make import make_vector_env, processes_save_time
from ba_torchrl.plugins import (
    MAIN,
    check_spawned_process_knows,
    import_modules,
    module_names,
)
from ba_torchrl.tasks.base import TASKS


def make_env(task: str, **config: Any) -> ManipulationEnv:
    """Make one environment; see `ba_torchrl.make`."""
    control = TASKS[task].control
    settings = parse_env_config(task, config)
    return CONTROLS[control](task, settings)


def resolve(task: str, **config: Any) -> EnvConfig:
    """Return the parameters of an environment, with the task's defaults in place of None.

    Parameters without a default stay None: overrides of the physics, colours, the seed.

    Args:
        task: id of the task.
        config: fields of `EnvConfig`.
    """
    task_class = TASKS[task]
    control, box = CONTROLS[task_class.control], task_class.workspace
    settings = parse_env_config(task, config)
    defaults = {
        "action_sequence": task_class.default_action_sequence or control.default_action_sequence,
        "half_rotation": control.default_half_rotation,
        "workspace": (box.x, box.y, box.z),
        "object_scale_range": task_class.scale_range,
        "max_steps": task_class.step_limit(settings.num_objects or task_class.num_objects),
        "num_objects": task_class.num_objects,
    }
    missing = {name: value for name, value in defaults.items() if getattr(settings, name) is None}
    return settings.model_copy(update=missing)


def make_vector(
    task: str,
    num_envs: int,
    *,
    parallel: bool | None,
    start_method: str,
    register_modules: Sequence[str | ModuleType] = (),
    make: Callable[..., ManipulationEnv] = make_env,
    timeout_s: float = 60.0,
    max_restarts: int = 5,
    start_timeout_s: float = 120.0,
    wait_for_restarts: bool = True,
    **config: Any,
) -> EnvBase:
    """Make environments that step together by ``make``; see `ba_torchrl.make_vector_env`."""
    modules = module_names(register_modules)
    import_modules(modules)
    settings = parse_env_config(task, config)
    if parallel is None:
        parallel = processes_save_time(num_envs)
    if parallel and start_method == "spawn":
        modules += _plugins_of(task, settings)
    return make_vector_env(
        partial(_import_and_make_env, modules, make, task, **config),
        num_envs,
        seed=settings.seed,
        parallel=parallel,
        start_method=start_method,
        timeout_s=timeout_s,
        max_restarts=max_restarts,
        start_timeout_s=start_timeout_s,
        wait_for_restarts=wait_for_restarts,
    )


def _plugins_of(task: str, settings: EnvConfig) -> tuple[str, ...]:
    """Return the modules that a new process imports before it can make an environment.

    Raises:
        ConfigError: one of them is defined where no other process can import it.
    """
    modules = []
    for registry, name, module in registering_modules(task, settings):
        if module in MAIN:
            check_spawned_process_knows(registry.kind, name)
        else:
            modules.append(module)
    return tuple(modules)


def _import_and_make_env(
    modules: Sequence[str], make: Callable[..., ManipulationEnv], task: str, **config: Any
) -> ManipulationEnv:
    import_modules(modules)
    return make(task, **config)
