"""Task: bodies, their random poses, the goal, and an expert that reaches it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np

from ba_torchrl.actions import GripperCommand, PickPlaceCommand
from ba_torchrl.config import TaskParameters
from ba_torchrl.errors import ConfigError
from ba_torchrl.registry import Registry
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import YawPose
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.terrain import Flat, Terrain
from ba_torchrl.tasks.workspace import ActionLimits, Spot, Workspace

TASKS: Registry[type[Task]] = Registry("task", "ba_torchrl.tasks")

BLOCK_M = 0.05
"""Edge of a block at scale 1."""

SCALE_STEP = 0.02


@dataclass(frozen=True)
class TaskSettings:
    """The part of the configuration that a task needs, with defaults filled in."""

    workspace: Workspace
    scale: float
    random_orientation: bool
    bounding_box_check: bool
    action_limits: ActionLimits
    num_objects: int
    parameters: TaskParameters = field(default_factory=TaskParameters)
    """The task's own parameters, an instance of `Task.Parameters`."""


class Task(ABC):
    """Bodies, their random poses, the goal, and an expert that reaches it.

    The constructor loads the bodies, once per world; every episode calls `initialize_episode`. The
    goal is tested in `evaluate` and nowhere else.

    Args:
        settings: the resolved configuration.
        world: not sealed yet.
        robot: loaded in this world.
        terrain: what the objects stand on; made by `make_terrain` if None.
    """

    control: ClassVar[Literal["open_loop", "close_loop"]]
    max_steps: ClassVar[int]
    workspace: ClassVar[Workspace]
    scale_range: ClassVar[tuple[float, float]]
    """Default scale of the objects."""
    scale_limits: ClassVar[tuple[float, float]]
    """Allowed scales, for every robot: the fingers neither meet the floor at smaller objects nor
    fail to close on larger ones."""
    num_objects: ClassVar[int] = 1
    """Default number of objects."""
    num_objects_range: ClassVar[tuple[int, int]] = (1, 1)
    """Allowed numbers of objects."""
    num_objects_step: ClassVar[int] = 1
    """Difference between allowed numbers of objects, counted from the least."""
    required_action_components: ClassVar[frozenset[str]] = frozenset()
    """Action components, as named by the action space, without which the task has no solution."""
    default_action_sequence: ClassVar[str | None] = None
    """Default `action_sequence`; None stands for that of the control."""
    terminates_at_limit: ClassVar[bool] = False
    """Whether the step limit is part of the task, so that reaching it terminates the episode."""
    fits_tray: ClassVar[bool] = False
    """Whether the objects fit the tray of `close_loop_tray`."""
    can_be_deconstructed: ClassVar[bool] = False
    """Whether `deconstruction` returns the reversed task."""
    needs_fresh_world: ClassVar[bool] = False
    """Whether exact repetition needs a newly built world. Where many bodies collide, the future
    also depends on the order of the engine's contact pairs, which no saved state holds."""

    Parameters: ClassVar[type[TaskParameters]] = TaskParameters
    """Model of the task's own parameters; its fields are keywords of `ba_torchrl.make`."""

    def __init__(
        self,
        settings: TaskSettings,
        world: World,
        robot: Robot,
        terrain: Terrain | None = None,
    ) -> None:
        self.settings = settings
        self.world = world
        self.robot = robot
        self.terrain = self.make_terrain() if terrain is None else terrain
        self.load_scene()

    def make_terrain(self) -> Terrain:
        """Load what the objects stand on: the floor, unless a task overrides this."""
        return Flat(self.world, self.settings.workspace)

    @classmethod
    def step_limit(cls, num_objects: int) -> int:
        """Return the default number of steps after which an episode is truncated.

        Args:
            num_objects: number of objects.
        """
        return cls.max_steps

    @abstractmethod
    def load_scene(self) -> None:
        """Load the task's bodies into `world`; called by the constructor."""

    @abstractmethod
    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Give the bodies new random poses.

        Raises:
            PlacementError: the workspace has no room.
        """

    @abstractmethod
    def evaluate(self) -> dict[str, bool]:
        """Return the named conditions of success, as the scene is now."""

    @abstractmethod
    def expert_command(self) -> GripperCommand | PickPlaceCommand:
        """Return the expert's command for the scene as it is now, whatever led to it."""

    @property
    @abstractmethod
    def objects(self) -> Sequence[Body]:
        """The bodies that must stay in the workspace."""

    @property
    def landmarks(self) -> Sequence[YawPose]:
        """Positions and yaws in the vector observation: by default those of the objects."""
        return [(body.position, body.yaw_rad) for body in self.objects]

    def is_success(self) -> bool:
        """Whether every condition of `evaluate` holds."""
        return all(self.evaluate().values())

    def is_valid(self) -> bool:
        """Whether every object that is not in the gripper is inside the workspace."""
        held = self.robot.held_body()
        return all(self._is_inside(body) for body in self.objects if body is not held)

    def is_valid_start(self) -> bool:
        """Whether an episode may start from the scene as it is now."""
        return self.is_valid() and not self.is_success()

    @property
    def continues(self) -> bool:
        """Whether the next episode keeps the objects where they are now."""
        return False

    def resume(self) -> None:  # noqa: B027 -- most tasks never continue
        """Start an episode that keeps the objects, the arm still where the last one ended.

        Called in place of `initialize_episode` if `continues` holds.
        """

    def after_action(self) -> None:  # noqa: B027 -- most tasks have no events
        """Carry out the task's own events, such as the arrival of an object.

        Called once an action has settled, before the scene is evaluated and observed.
        """

    def deconstruction(self) -> Task:
        """Return the task that takes apart what this one builds, in the same world.

        Raises:
            NotImplementedError: there is none; see `can_be_deconstructed`.
        """
        raise NotImplementedError(f"{type(self).__name__} has no deconstruction")

    def get_state(self) -> Any:
        """Return the task's state beyond the poses of its bodies."""
        return None

    def set_state(self, state: Any) -> None:
        """Restore a state of `get_state`.

        Raises:
            ValueError: the task has no such state.
        """
        if state is not None:
            raise ValueError(f"{type(self).__name__} has no state beyond its bodies' poses")

    @property
    def block_m(self) -> float:
        """Edge of this episode's block."""
        return BLOCK_M * self.settings.scale

    @property
    def action_limits(self) -> ActionLimits:
        """Displacement and rotation of one action."""
        return self.settings.action_limits

    def _is_inside(self, body: Body) -> bool:
        workspace = self.settings.workspace
        if not self.settings.bounding_box_check:
            return workspace.contains(body.position)
        (x0, y0, _), (x1, y1, top) = body.bounding_box()
        # only the top corners: a resting body penetrates its support by micrometres
        return workspace.contains((x0, y0, top)) and workspace.contains((x1, y1, top))

    # -- random poses ------------------------------------------------------------------------

    def random_point(self, rng: np.random.Generator, padding_m: float) -> tuple[float, float]:
        """Return a point of the ground that keeps half of ``padding_m`` from the border.

        Raises:
            PlacementError: the workspace is too small.
        """
        return self.terrain.random_point(rng, padding_m)

    def random_points(
        self, rng: np.random.Generator, spots: Sequence[Spot]
    ) -> list[tuple[float, float]]:
        """Return points of the ground, one for each spot, apart from each other.

        Raises:
            PlacementError: the workspace has no room for them.
        """
        return self.terrain.random_points(rng, spots)

    def random_yaw(self, rng: np.random.Generator, span_rad: float) -> float:
        """Return a yaw uniform over ``span_rad`` about zero, or zero for fixed orientations."""
        if not self.settings.random_orientation:
            return 0.0
        return float(rng.uniform(-span_rad / 2, span_rad / 2))

    def stand(self, body: Body, xy: tuple[float, float], yaw_rad: float) -> None:
        """Put a body at rest on the ground."""
        self.terrain.stand(body, xy, yaw_rad)


def check_scales(task_id: str, scales: tuple[float, float]) -> None:
    """Check that a task can be solved with objects of these scales.

    Args:
        task_id: as listed by `ba_torchrl.list_tasks`.
        scales: the smallest and the largest.

    Raises:
        ConfigError: they are outside the task's limits.
    """
    least, most = TASKS[task_id].scale_limits
    low, high = scales
    if round(low, 6) < least or round(high, 6) > most:
        allowed = f"{least:g} to {most:g}" if least < most else f"{least:g} only"
        raise ConfigError(
            f"{task_id}: `object_scale_range` must lie within {allowed}, not ({low:g}, {high:g})"
        )
