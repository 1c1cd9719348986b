"""Scene: a sealed world with its robot, task, controller and camera, built from a configuration."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from ba_torchrl.core.env_config import CUSTOM_PHYSICS, EnvConfig
from ba_torchrl.core.errors import ConfigError, SimulationError
from ba_torchrl.sim.geometry import downward
from ba_torchrl.sim.robots.base import ROBOTS, Robot
from ba_torchrl.sim.shapes import Decal
from ba_torchrl.sim.vision.depth import HeightCamera
from ba_torchrl.sim.world import FINE_PHYSICS, Physics, Snapshot, World
from ba_torchrl.tasks.base import Task, TaskSettings
from ba_torchrl.tasks.terrain.tray import Tray
from ba_torchrl.tasks.workspace import Workspace

MARK_M = 1e-3
"""Thickness of the coloured sheet that marks the workspace."""


class Controller(Protocol):
    """Executes actions; each control defines the methods for its actions."""

    is_out_of_reach: bool
    """Whether the pose of the last action was out of reach. The arm then does not move in open
    loop, and moves up to the end of its reach in close loop."""

    def get_state(self) -> Any:
        """Return the state that persists between actions."""

    def set_state(self, state: Any) -> None:
        """Restore a state that `get_state` returned."""


@dataclass(frozen=True)
class SceneState:
    """The full state of a scene."""

    world: Snapshot
    robot: Any
    controller: Any
    task: Any
    terrain: Any
    hidden: tuple[bool, ...]
    """Whether each body is hidden."""
    inactive: tuple[bool, ...]
    """Whether each body is inactive."""


@dataclass
class Scene:
    """A sealed world with its robot, task, controller and camera."""

    world: World
    robot: Robot
    task: Task
    controller: Controller
    camera: HeightCamera

    def get_state(self) -> SceneState:
        """Return the state."""
        return SceneState(
            self.world.snapshot(),
            self.robot.get_state(),
            self.controller.get_state(),
            self.task.get_state(),
            self.task.terrain.get_state(),
            tuple(body.is_hidden for body in self.world.bodies),
            tuple(body.is_inactive for body in self.world.bodies),
        )

    def set_state(self, state: SceneState) -> None:
        """Restore a state of this scene, or of one with the same bodies."""
        self.world.restore(state.world)
        self.task.terrain.set_state(state.terrain)
        self.task.set_state(state.task)
        self.robot.set_state(state.robot)
        self.controller.set_state(state.controller)
        for body, is_hidden, is_inactive in zip(
            self.world.bodies, state.hidden, state.inactive, strict=True
        ):
            body.set_inactive(is_inactive)
            body.is_hidden = is_hidden


def build_scene(
    task_class: type[Task],
    settings: TaskSettings,
    config: EnvConfig,
    *,
    physics: Physics,
    make_controller: Callable[[Robot, Task], Controller],
    window: bool,
) -> Scene:
    """Build the world of a task for objects of one scale.

    Args:
        physics: settings of the engine, which the configuration can override.
    """
    world = _empty_world(config, settings.workspace, physics, window)
    terrain = Tray(world, settings.workspace) if config.close_loop_tray else None
    robot = ROBOTS[config.robot](world)
    task = task_class(settings, world, robot, terrain)
    world.seal()
    return Scene(world, robot, task, make_controller(robot, task), HeightCamera(world.bodies))


def check_action_limits(robot: Robot, workspace: Workspace, heights_m: Sequence[float]) -> None:
    """Check that a robot reaches some heights at every corner of the workspace."""
    for x in workspace.x:
        for y in workspace.y:
            for z in heights_m:
                if robot.inverse_kinematics((x, y, z), downward(0.0)) is None:
                    name = next(name for name in ROBOTS if ROBOTS[name] is type(robot))
                    raise ConfigError(
                        f"workspace: {name} cannot reach its corner ({x:g}, {y:g}, {z:g}) m with "
                        "the gripper pointing down"
                    )


def _empty_world(config: EnvConfig, workspace: Workspace, physics: Physics, window: bool) -> World:
    """Return a world with a floor only."""
    if config.physics_mode == "slow":
        physics = FINE_PHYSICS
    custom = {
        name: getattr(config, name) for name in CUSTOM_PHYSICS if getattr(config, name) is not None
    }
    color = None if config.floor_color is None else (*config.floor_color, 1.0)
    try:
        world = World(dataclasses.replace(physics, **custom), window=window, floor_color=color)
    except SimulationError as error:
        if window:
            raise ConfigError(str(error)) from None
        raise
    if config.workspace_color is not None:
        (x0, x1), (y0, y1) = workspace.x, workspace.y
        mark = Decal(size_m=(x1 - x0, y1 - y0, MARK_M), color=(*config.workspace_color, 1.0))
        world.add(mark, "workspace").place((*workspace.center, MARK_M / 2))
    return world
