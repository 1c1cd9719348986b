"""Task: what there is to do, told apart from how it is controlled and observed."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from ba_torchrl.actions import GripperCommand, PickPlaceCommand
from ba_torchrl.errors import ConfigError, PlacementError
from ba_torchrl.registry import Registry
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Vector, YawPose
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.world import World

TASKS: Registry[type[Task]] = Registry("task", "ba_torchrl.tasks")

BLOCK_M = 0.05
"""Edge of a block at scale 1."""

SCALE_STEP = 0.02


LAYOUT_ATTEMPTS = 2000
"""Random layouts tried before giving up; bowl and block fit in about one of ten."""


class Spot(NamedTuple):
    """Room that an object needs."""

    padding_m: float
    """Twice the distance that its centre keeps from the border."""
    distance_m: float
    """Distance that its centre keeps from those placed before it."""


@dataclass(frozen=True)
class Workspace:
    """An axis-aligned box in metres."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float]

    @property
    def center(self) -> tuple[float, float]:
        """Middle of the floor area."""
        return (sum(self.x) / 2, sum(self.y) / 2)

    @property
    def width(self) -> float:
        """Extent along x."""
        return self.x[1] - self.x[0]

    def contains(self, point: Vector) -> bool:
        """Whether a point lies strictly inside."""
        return all(
            low < value < high
            for value, (low, high) in zip(point, (self.x, self.y, self.z), strict=True)
        )

    def clip(self, point: Sequence[float]) -> Vector:
        """Return the nearest point of the box."""
        return tuple(
            min(max(value, low), high)
            for value, (low, high) in zip(point, (self.x, self.y, self.z), strict=True)
        )


@dataclass(frozen=True)
class ActionLimits:
    """What one action covers: experts plan their approach by it."""

    step_m: float
    turn_rad: float
    """0 if the gripper cannot be turned."""
    yaw_range_rad: tuple[float, float] | None = None
    """What the gripper's yaw is kept within, if anything."""


@dataclass(frozen=True)
class TaskSettings:
    """What of the configuration a task needs, defaults filled in."""

    workspace: Workspace
    scale: float
    random_orientation: bool
    bounding_box_check: bool
    action_limits: ActionLimits
    num_objects: int
    surface_z_m: float = 0.0
    """Height of what the objects stand on."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Values of `Task.parameters`."""


class Task(ABC):
    """Bodies, their random poses, the goal, and an expert that reaches it.

    A task is built once per world: `build` loads the bodies, then every episode calls
    `randomise`. The goal is tested here and nowhere else.

    Args:
        settings: the resolved configuration.
    """

    control: ClassVar[Literal["open_loop", "close_loop"]]
    max_steps: ClassVar[int]
    workspace: ClassVar[Workspace]
    scale_range: ClassVar[tuple[float, float]]
    """Scale of the objects by default."""
    scale_limits: ClassVar[tuple[float, float]]
    """What it may be, whichever robot comes. Of smaller objects the fingers meet the floor, or the
    middle is below the workspace; larger ones do not fit between fingers or beside each other."""
    num_objects: ClassVar[int] = 1
    """How many objects there are by default."""
    num_objects_range: ClassVar[tuple[int, int]] = (1, 1)
    """How many there may be."""
    num_objects_step: ClassVar[int] = 1
    """They come in the least number and this many more, again and again."""
    terminates_at_limit: ClassVar[bool] = False
    """Whether the step limit is the task: reaching it terminates the episode."""
    fits_tray: ClassVar[bool] = False
    """Whether everything has room in the tray of `close_loop_tray`."""
    needs_fresh_world: ClassVar[bool] = False
    """Whether so much collides that a seed or a state repeats its future exactly only in a new
    world: how the engine has sorted its lists of what may collide is in no saved state."""
    parameters: ClassVar[frozenset[str]] = frozenset()
    """Fields of `EnvConfig` for some tasks only that this one takes."""

    def __init__(self, settings: TaskSettings) -> None:
        self.settings = settings
        self.world: World
        self.robot: Robot

    @classmethod
    def step_limit(cls, num_objects: int) -> int:
        """Return the steps after which an episode is truncated by default.

        Args:
            num_objects: how many objects there are.
        """
        return cls.max_steps

    @abstractmethod
    def build(self, world: World) -> None:
        """Load the task's bodies into the world."""

    @abstractmethod
    def randomise(self, rng: np.random.Generator) -> None:
        """Give the bodies new random poses.

        Raises:
            PlacementError: the workspace has no room.
        """

    @abstractmethod
    def is_goal(self) -> bool:
        """Whether the goal holds in the scene as it is now."""

    @abstractmethod
    def expert_command(self) -> GripperCommand | PickPlaceCommand:
        """Return what the expert does now; a function of the scene, from any state."""

    @property
    @abstractmethod
    def objects(self) -> Sequence[Body]:
        """The bodies that must stay in the workspace."""

    @property
    def landmarks(self) -> Sequence[YawPose]:
        """Positions and yaws that the vector observation lists: by default the objects'."""
        return [(body.position, body.yaw_rad) for body in self.objects]

    def is_start(self) -> bool:
        """Whether an episode may start from the scene as it is now."""
        return self.is_valid() and not self.is_goal()

    @property
    def continues(self) -> bool:
        """Whether the next episode goes on with the objects as they are now."""
        return False

    def resume(self) -> None:  # noqa: B027 -- most tasks never continue
        """Start an episode that goes on with the objects, the arm still where the last one ended.

        Called if `continues` says so, in place of `randomise`.
        """

    def after_action(self) -> None:  # noqa: B027 -- most tasks have nothing to do
        """Let the task's own events happen, such as a new object: an action has just settled.

        Goal and validity are judged after it, and the observation shows what it did.
        """

    def get_state(self) -> Any:
        """Return what the task remembers beyond the poses of its bodies."""
        return None

    def set_state(self, state: Any) -> None:
        """Take up what `get_state` returned."""
        if state is not None:
            raise ValueError(f"{type(self).__name__} remembers nothing beyond its bodies' poses")

    @property
    def block_m(self) -> float:
        """Edge of this episode's block."""
        return BLOCK_M * self.settings.scale

    @property
    def action_limits(self) -> ActionLimits:
        """What one action of the expert covers."""
        return self.settings.action_limits

    def is_valid(self) -> bool:
        """Whether every object that is not in the gripper is inside the workspace."""
        held = self.robot.held_body()
        return all(self._is_inside(body) for body in self.objects if body is not held)

    def _is_inside(self, body: Body) -> bool:
        workspace = self.settings.workspace
        if not self.settings.bounding_box_check:
            return workspace.contains(body.position)
        (x0, y0, _), (x1, y1, top) = body.bounding_box()
        # the top corners: a body at rest dips a hair below the floor
        return workspace.contains((x0, y0, top)) and workspace.contains((x1, y1, top))

    def random_point(self, rng: np.random.Generator, padding_m: float) -> tuple[float, float]:
        """Return a point of the floor that keeps half of ``padding_m`` from the border.

        Raises:
            PlacementError: the workspace is smaller than that.
        """
        point = []
        for low, high in (self.settings.workspace.x, self.settings.workspace.y):
            low, high = low + padding_m / 2, high - padding_m / 2
            if low >= high:
                raise PlacementError(
                    f"an object that keeps {padding_m / 2:.3f} m from the border does not fit: "
                    "enlarge `workspace` or lower `object_scale_range`"
                )
            point.append(float(rng.uniform(low, high)))
        return tuple(point)

    def random_points(
        self, rng: np.random.Generator, spots: Sequence[Spot]
    ) -> list[tuple[float, float]]:
        """Return random points of the floor, one for each spot, apart from each other.

        Raises:
            PlacementError: the workspace has no room for them.
        """
        for _ in range(LAYOUT_ATTEMPTS):
            points: list[tuple[float, float]] = []
            for spot in spots:
                point = self.random_point(rng, spot.padding_m)
                if any(math.dist(point, other) < spot.distance_m for other in points):
                    break
                points.append(point)
            else:
                return points
        raise PlacementError(
            f"no room for {len(spots)} things apart from each other: enlarge `workspace`, or lower "
            "`num_objects` or `object_scale_range`"
        )

    def random_yaw(self, rng: np.random.Generator, span_rad: float) -> float:
        """Return a yaw uniform over ``span_rad`` about zero, or zero for fixed orientations."""
        if not self.settings.random_orientation:
            return 0.0
        return float(rng.uniform(-span_rad / 2, span_rad / 2))

    def stand(self, body: Body, xy: tuple[float, float], yaw_rad: float) -> None:
        """Put a body on the floor, or on the tray's."""
        body.place((*xy, self.settings.surface_z_m - body.shape.bounds_m[0][2]), yaw_rad)


def check_scales(task_id: str, scales: tuple[float, float]) -> None:
    """Check that a task can be solved with objects of these scales.

    Args:
        task_id: as listed by `ba_torchrl.list_tasks`.
        scales: the smallest and the largest.

    Raises:
        ConfigError: they go beyond the task's limits.
    """
    least, most = TASKS[task_id].scale_limits
    low, high = scales
    if round(low, 6) < least or round(high, 6) > most:
        allowed = f"{least:g} to {most:g}" if least < most else f"{least:g} only"
        raise ConfigError(
            f"{task_id}: `object_scale_range` must lie within {allowed}, not ({low:g}, {high:g})"
        )
