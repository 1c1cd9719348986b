"""ResolvedEnv: an environment's task and parameters, validated, with every default filled in."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

from ba_torchrl.core.actions import CloseLoopActions, OpenLoopActions
from ba_torchrl.core.config import parse
from ba_torchrl.core.env_config import EnvConfig, env_config_model
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.plugins import MAIN, check_spawned_process_knows, import_modules
from ba_torchrl.core.registry import Registry
from ba_torchrl.sim.robots.base import ROBOTS, Robot
from ba_torchrl.tasks.base import TASKS, Task, TaskSettings
from ba_torchrl.tasks.workspace import ActionLimits, Workspace


class ControlConfig(ABC):
    """What a control declares besides its environments. Its module imports no torch."""

    env: ClassVar[str]
    """The class of its environments, as "module:class"."""
    default_action_sequence: ClassVar[str]
    """Default `action_sequence`."""
    default_half_rotation: ClassVar[bool]
    """Default `half_rotation`."""
    video_fps: ClassVar[int]
    """Frames of a video per second."""

    @classmethod
    @abstractmethod
    def make_actions(cls, config: EnvConfig) -> CloseLoopActions | OpenLoopActions:
        """Return the action space."""


CONTROLS: Registry[type[ControlConfig]] = Registry(
    "kind of control", "ba_torchrl.envs", ControlConfig, "_config"
)


@dataclass(frozen=True)
class ResolvedEnv:
    """A task and all parameters of its environment, defaults filled in; see `resolve_env`.

    Another process that unpickles it imports `modules` first.
    """

    task_id: str
    config: EnvConfig
    """The parameters. Of them, only changes of the physics, colours, the seed, the
    cameras' size and, in close loop, the parameters of open loop can be None."""
    actions: CloseLoopActions | OpenLoopActions
    """The action space."""
    modules: tuple[str, ...]
    """Modules outside the package to import before the environment can be made."""

    @property
    def given(self) -> dict[str, Any]:
        """The parameters that were given, without the defaults of task and control."""
        return self.config.model_dump(exclude_unset=True)

    @property
    def task_class(self) -> type[Task]:
        """The class of the task."""
        return TASKS[self.task_id]

    @property
    def control(self) -> type[ControlConfig]:
        """The declarations of the task's control, close loop or open loop."""
        return CONTROLS[self.task_class.control]

    @property
    def video_fps(self) -> int:
        """Frames of a video per second."""
        return self.control.video_fps

    @property
    def robot_class(self) -> type[Robot]:
        """The class of the robot."""
        return ROBOTS[self.config.robot]

    @cached_property
    def workspace(self) -> Workspace:
        """Bounds of the task."""
        return Workspace(*self.config.workspace)

    def task_settings(self, scale: float, limits: ActionLimits) -> TaskSettings:
        """Return the settings of the task for objects of one scale."""
        config, model = self.config, self.task_class.Parameters
        return TaskSettings(
            workspace=self.workspace,
            scale=scale,
            random_orientation=config.random_orientation,
            bounding_box_check=config.workspace_check == "bounding_box",
            action_limits=limits,
            num_objects=config.num_objects,
            parameters=model(**{name: getattr(config, name) for name in model.model_fields}),
        )

    def changed(self, **changes: Any) -> ResolvedEnv:
        """Return a copy in which some parameters have other values, resolved anew."""
        return resolve_env(self, changes)

    def without_window(self) -> ResolvedEnv:
        """Return the environment without PyBullet's window, which belongs to a machine."""
        return self.changed(render=False) if self.config.render else self

    def check_spawned_process_knows(self) -> None:
        """Check that a spawned process can import the modules of the environment's parts."""
        for registry, name, module in _plugins(self.task_id, self.config):
            if module in MAIN:
                check_spawned_process_knows(registry.kind, name)

    def __reduce__(self) -> tuple[Any, ...]:
        return _blank, (self.modules,), dict(vars(self))


def _blank(modules: Iterable[str]) -> ResolvedEnv:
    """Import modules, and return what gets its fields from a pickle."""
    import_modules(modules)
    return ResolvedEnv.__new__(ResolvedEnv)


def resolve_env(
    task: str | ResolvedEnv,
    values: Mapping[str, Any],
    what: str | None = None,
    modules: Iterable[str] = (),
) -> ResolvedEnv:
    """Validate the parameters of an environment and fill in the defaults of task and control.

    A parameter of other tasks is dropped if it has its default value, so that a complete
    configuration of one task is valid for another.

    Args:
        task: as listed by `ba_torchrl.list_tasks`, or what this function returned, whose values and
            modules are used in addition.
        values: fields of `EnvConfig` and of the task's parameters.
        what: name of the configuration in the error message.
        modules: outside the package, to import first. Those that register the task, the robot and
            the observations need not be named.

    Raises:
        ConfigError: a name is unknown, a type wrong or a value out of range, the task does not
            support a value, or a module does not exist.
    """
    modules = tuple(modules)
    if isinstance(task, ResolvedEnv):
        if not values and not modules:
            return task
        values, modules = {**task.given, **values}, (*task.modules, *modules)
    task_id = task.task_id if isinstance(task, ResolvedEnv) else task
    import_modules(modules)
    task_class = TASKS[task_id]
    model = env_config_model(task_class.Parameters)
    given = _own_values(task_id, values, model)
    known = model.fields_for(task_class.control)
    config = parse(model, given, what or f"configuration of {task_id}", known)
    config.check_control(task_id, task_class.control)
    _check_task_supports(task_id, config)
    _ = ROBOTS[config.robot]  # raises with the known names
    config = _with_defaults(task_class, config)
    actions = CONTROLS[task_class.control].make_actions(config)
    missing = sorted(task_class.required_action_components - set(actions.components))
    if missing:
        raise ConfigError(
            f"action_sequence: {task_id} cannot be solved without the components "
            f"{', '.join(missing)}; the sequence has {', '.join(actions.components)}"
        )
    registering = (module for *_, module in _plugins(task_id, config) if module not in MAIN)
    modules = tuple(dict.fromkeys([*modules, *registering]))
    if config.camera_size is not None:
        from ba_torchrl.envs.observations import enabled_classes  # imports torch

        if not any(part.uses_camera for part in enabled_classes(config)):
            raise ConfigError(
                "camera_size has no effect without rgb=True, or 'wrist_rgb' or 'segmentation' in "
                "observations"
            )
    return ResolvedEnv(task_id, config, actions, modules)


def _plugins(task_id: str, config: EnvConfig) -> Iterator[tuple[Registry[Any], str, str]]:
    """Yield the parts that modules outside the package have registered.

    Yields:
        Registry, name in it, and module.
    """
    parts = [(TASKS, task_id), (ROBOTS, config.robot)]
    if config.observations:
        from ba_torchrl.envs.observations import OBSERVATIONS  # imports torch

        parts += [(OBSERVATIONS, name) for name in config.observations]
    for registry, name in parts:
        module = registry.plugin_module(name)
        if module is not None:
            yield registry, name, module


def _own_values(task_id: str, values: Mapping[str, Any], model: type[EnvConfig]) -> dict[str, Any]:
    """Return the values without defaults of other tasks' parameters."""
    own = dict(values)
    for name in values.keys() - model.model_fields.keys():
        fields = {other: TASKS[other].Parameters.model_fields.get(name) for other in TASKS}
        defaults = {other: field.default for other, field in fields.items() if field is not None}
        if defaults and own.pop(name) not in defaults.values():
            raise ConfigError(
                f"{name!r} has no meaning for {task_id}: leave it out; it is a parameter of "
                f"{', '.join(defaults)}"
            )
    return own


def _with_defaults(task_class: type[Task], config: EnvConfig) -> EnvConfig:
    """Return a configuration with the defaults of task and control in place of None, which are not
    among the fields that were set."""
    control, box = CONTROLS[task_class.control], task_class.workspace
    defaults = {
        "action_sequence": task_class.default_action_sequence or control.default_action_sequence,
        "half_rotation": control.default_half_rotation,
        "workspace": (box.x, box.y, box.z),
        "object_scale_range": task_class.scale_range,
        "max_steps": task_class.step_limit(config.num_objects or task_class.num_objects),
        "num_objects": task_class.num_objects,
    }
    if task_class.control == "open_loop":
        defaults["in_hand_mode"] = task_class.default_in_hand_mode
        defaults["in_hand_size"] = task_class.default_in_hand_size
    missing = {name: value for name, value in defaults.items() if getattr(config, name) is None}
    given = config.model_fields_set - missing.keys()
    return type(config).model_construct(given, **{**dict(config), **missing})


def check_scales(task_id: str, scales: tuple[float, float]) -> None:
    """Raise `ConfigError` unless scales are within the limits of a task."""
    least, most = TASKS[task_id].scale_limits
    low, high = scales
    if round(low, 6) < least or round(high, 6) > most:
        allowed = f"{least:g} to {most:g}" if least < most else f"{least:g} only"
        raise ConfigError(
            f"{task_id}: `object_scale_range` must lie within {allowed}, not ({low:g}, {high:g})"
        )


def _check_task_supports(task_id: str, config: EnvConfig) -> None:
    """Check that a task supports the parameters of a configuration."""
    task_class = TASKS[task_id]
    if config.object_scale_range is not None:
        check_scales(task_id, config.object_scale_range)
    least, most = task_class.num_objects_range
    numbers = range(least, most + 1, task_class.num_objects_step)
    if config.num_objects is not None and config.num_objects not in numbers:
        allowed = str(least) if least == most else f"{least} to {most}"
        if numbers.step > 1:
            allowed = f"{', '.join(map(str, numbers[:-1]))} or {numbers[-1]}"
        raise ConfigError(f"num_objects: {task_id} has {allowed}, not {config.num_objects}")
    if config.reward != "sparse" and task_class.progress is Task.progress:
        dense = ", ".join(name for name in TASKS if TASKS[name].progress is not Task.progress)
        raise ConfigError(f"reward: {task_id} has no dense reward; it is for {dense}")
    if config.close_loop_tray and not task_class.fits_tray:
        fitting = ", ".join(name for name in TASKS if TASKS[name].fits_tray)
        raise ConfigError(
            f"close_loop_tray: the tray has no room for {task_id}; it is for {fitting}"
        )
