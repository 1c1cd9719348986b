"""Validation of an environment's configuration for its task."""

from __future__ import annotations

from typing import Any

from ba_torchrl.config import EnvConfig, TaskParameters, env_config_model, parse
from ba_torchrl.errors import ConfigError
from ba_torchrl.tasks.base import TASKS, Task, check_scales


def parse_env_config(task_id: str, values: dict[str, Any], what: str | None = None) -> EnvConfig:
    """Validate the parameters of an environment, those of its task included.

    A parameter of other tasks is dropped if it has its default value, so that a complete
    configuration of one task is valid for another. The task's default of `in_hand_size` and, in
    open loop, that of `in_hand_mode` are filled in.

    Args:
        task_id: as listed by `ba_torchrl.list_tasks`.
        values: field names and their values.
        what: name of the configuration in the error message.

    Raises:
        ConfigError: a name is unknown, a type wrong or a value out of range.
    """
    model = env_config_model(TASKS[task_id].Parameters)
    values = dict(values)
    for name in values.keys() - model.model_fields.keys():
        defaults = _tasks_with_parameter(name)
        if defaults and all(values[name] != default for default in defaults.values()):
            raise ConfigError(
                f"{name!r} has no meaning for {task_id}: leave it out; it is a parameter of "
                f"{', '.join(defaults)}"
            )
        if defaults:
            del values[name]
    config = parse(model, values, what or f"configuration of {task_id}")
    task_class = TASKS[task_id]
    filled_in = _filled_in(task_class)
    if task_class.control == "open_loop":
        filled_in["in_hand_mode"] = task_class.default_in_hand_mode
    missing = {name: value for name, value in filled_in.items() if getattr(config, name) is None}
    return config.model_copy(update=missing)


def task_parameters(task_class: type[Task], config: EnvConfig) -> TaskParameters:
    """Return the task's parameters in a configuration."""
    model = task_class.Parameters
    return model(**{name: getattr(config, name) for name in model.model_fields})


def check_task_parameters(task_id: str, config: EnvConfig) -> None:
    """Check that a task supports the parameters of a configuration.

    Raises:
        ConfigError: a parameter has no meaning for the task, or an unsupported value.
    """
    task_class = TASKS[task_id]
    config.check_control(task_id, task_class.control, _filled_in(task_class))
    if config.object_scale_range is not None:
        check_scales(task_id, config.object_scale_range)
    least, most = task_class.num_objects_range
    numbers = range(least, most + 1, task_class.num_objects_step)
    if config.num_objects is not None and config.num_objects not in numbers:
        allowed = str(least) if least == most else f"{least} to {most}"
        if numbers.step > 1:
            allowed = f"{', '.join(map(str, numbers[:-1]))} or {numbers[-1]}"
        raise ConfigError(
            f"num_objects: {task_id} takes {allowed} objects, not {config.num_objects}"
        )
    if config.close_loop_tray and not task_class.fits_tray:
        fitting = ", ".join(name for name in TASKS if TASKS[name].fits_tray)
        raise ConfigError(
            f"close_loop_tray: the tray has no room for {task_id}; it is for {fitting}"
        )


def check_action_components(task_id: str, components: list[str]) -> None:
    """Check that an action space has the components that a task needs.

    Args:
        task_id: as listed by `ba_torchrl.list_tasks`.
        components: as named by the action space.

    Raises:
        ConfigError: one is missing.
    """
    missing = sorted(TASKS[task_id].required_action_components - set(components))
    if missing:
        raise ConfigError(
            f"action_sequence: {task_id} cannot be solved without the components "
            f"{', '.join(missing)}; the sequence has {', '.join(components)}"
        )


def _filled_in(task_class: type[Task]) -> dict[str, Any]:
    """Return the values that tasks of both controls fill in where None is given."""
    return {"in_hand_size": task_class.default_in_hand_size}


def _tasks_with_parameter(name: str) -> dict[str, Any]:
    """Return the default of a parameter in each task that declares it."""
    return {
        task_id: TASKS[task_id].Parameters.model_fields[name].default
        for task_id in TASKS
        if name in TASKS[task_id].Parameters.model_fields
    }
