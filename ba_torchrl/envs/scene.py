"""Scene: a sealed world with robot, task and what watches them, built from a configuration."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from ba_torchrl.config import CUSTOM_PHYSICS, EnvConfig
from ba_torchrl.errors import ConfigError, SimulationError
from ba_torchrl.sim.bodies import Decal
from ba_torchrl.sim.geometry import downward
from ba_torchrl.sim.robots.base import ROBOTS, Robot
from ba_torchrl.sim.vision.depth import HeightCamera
from ba_torchrl.sim.world import FINE_PHYSICS, Physics, SavedState, Snapshot, World
from ba_torchrl.tasks.base import TASKS, ActionLimits, Task, TaskSettings, Workspace, check_scales
from ba_torchrl.tasks.clutter.tray import add_tray
from ba_torchrl.tasks.structures.deconstruction import Deconstruction

MARK_M = 1e-3
"""Thickness of the coloured sheet that marks the workspace."""


class Motion(Protocol):
    """What carries out actions; its methods beyond these are the control's own."""

    def get_state(self) -> Any:
        """Return what it remembers from one action to the next."""

    def set_state(self, state: Any) -> None:
        """Take up what `get_state` returned."""


@dataclass(frozen=True)
class SceneState:
    """Everything in a scene, at one moment."""

    world: Snapshot | SavedState
    robot: Any
    motion: Any
    task: Any
    hidden: tuple[bool, ...]
    """Of each body, whether it is put aside."""


@dataclass
class Scene:
    """A sealed world with everything in it."""

    world: World
    robot: Robot
    task: Task
    motion: Motion
    camera: HeightCamera

    def get_state(self, *, outlives_world: bool = False) -> SceneState:
        """Return the state to come back to.

        Args:
            outlives_world: another scene that was built alike can take it up, too.
        """
        return SceneState(
            self.world.save() if outlives_world else self.world.snapshot(),
            self.robot.get_state(),
            self.motion.get_state(),
            self.task.get_state(),
            tuple(body.is_hidden for body in self.world.bodies),
        )

    def set_state(self, state: SceneState) -> None:
        """Return to a state of this scene, or to one that outlives its world.

        Raises:
            SimulationError: it is another scene's.
        """
        if isinstance(state.world, SavedState):
            self.world.load(state.world)
        else:
            self.world.restore(state.world)
        self.task.set_state(state.task)
        self.robot.set_state(state.robot)
        self.motion.set_state(state.motion)
        for body, is_hidden in zip(self.world.bodies, state.hidden, strict=True):
            body.is_hidden = is_hidden


def build_scene(
    task_id: str,
    config: EnvConfig,
    *,
    workspace: Workspace,
    limits: ActionLimits,
    scale: float,
    physics: Physics,
    make_motion: Callable[[Robot, Task], Motion],
) -> Scene:
    """Build the world of a task for objects of one scale.

    Args:
        task_id: as listed by `ba_torchrl.list_tasks`.
        config: the environment's parameters.
        workspace: where the task takes place.
        limits: what one action covers.
        scale: of the objects.
        physics: settings of the engine, unless the parameters say otherwise.
        make_motion: from a robot and a task to what carries out actions.

    Raises:
        ConfigError: there is no display for ``render=True``.
    """
    task_class = TASKS[task_id]
    world = _empty_world(config, workspace, physics)
    surface_z_m = 0.0
    if config.close_loop_tray:
        surface_z_m = add_tray(world, workspace.center, workspace.width)
    task = task_class(
        TaskSettings(
            workspace=workspace,
            scale=scale,
            random_orientation=config.random_orientation,
            bounding_box_check=config.workspace_check == "bounding_box",
            action_limits=limits,
            num_objects=(
                task_class.num_objects if config.num_objects is None else config.num_objects
            ),
            surface_z_m=surface_z_m,
            parameters={name: getattr(config, name) for name in task_class.parameters},
        )
    )
    if config.deconstruct:
        task = Deconstruction(task)
    task.world, task.robot = world, ROBOTS[config.robot](world)
    task.build(world)
    world.seal()
    motion = make_motion(task.robot, task)
    return Scene(world, task.robot, task, motion, HeightCamera(world.bodies))


def check_task_parameters(task_id: str, config: EnvConfig) -> None:
    """Check that a task can be had with these parameters.

    Raises:
        ConfigError: one has no meaning for it, or a value it does not take.
    """
    task_class = TASKS[task_id]
    config.check_for(task_id, task_class.control, task_class.parameters)
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


def check_action_limits(robot: Robot, workspace: Workspace, heights_m: Sequence[float]) -> None:
    """Check that a robot reaches above every corner of the workspace.

    Raises:
        ConfigError: it does not.
    """
    for x in workspace.x:
        for y in workspace.y:
            for z in heights_m:
                if robot.inverse_kinematics((x, y, z), downward(0.0)) is None:
                    name = next(name for name in ROBOTS if ROBOTS[name] is type(robot))
                    raise ConfigError(
                        f"workspace: {name} cannot reach its corner ({x:g}, {y:g}, {z:g}) m with "
                        "the gripper pointing down"
                    )


def _empty_world(config: EnvConfig, workspace: Workspace, physics: Physics) -> World:
    """Return a world with nothing but the floor."""
    if config.physics_mode == "slow":
        physics = FINE_PHYSICS
    custom = {
        name: getattr(config, name) for name in CUSTOM_PHYSICS if getattr(config, name) is not None
    }
    color = None if config.floor_color is None else (*config.floor_color, 1.0)
    try:
        world = World(
            dataclasses.replace(physics, **custom), window=config.render, floor_color=color
        )
    except SimulationError as error:
        if config.render:
            raise ConfigError(str(error)) from None
        raise
    if config.workspace_color is not None:
        (x0, x1), (y0, y1) = workspace.x, workspace.y
        mark = Decal(size_m=(x1 - x0, y1 - y0, MARK_M), color=(*config.workspace_color, 1.0))
        world.add(mark, "workspace").place((*workspace.center, MARK_M / 2))
    return world
