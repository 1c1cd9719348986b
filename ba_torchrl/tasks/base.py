"""Task: bodies, their random poses, the goal, and an expert that reaches it.

`OpenLoopTask` and `CloseLoopTask` add the defaults of the two kinds of control.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from ba_torchrl.core.actions import GripperCommand, PickPlaceCommand
from ba_torchrl.core.config import TaskParameters
from ba_torchrl.core.errors import PlacementError
from ba_torchrl.core.registry import Registry
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Matrix, YawPose
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.shapes import Box, Color
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.goals import Goal
from ba_torchrl.tasks.terrain.flat import Flat, Terrain
from ba_torchrl.tasks.workspace import ActionLimits, Workspace

BLOCK_M = 0.05
"""Edge of a block at scale 1."""

RED: Color = (0.82, 0.22, 0.2, 1.0)
BLUE: Color = (0.2, 0.4, 0.8, 1.0)
GREEN: Color = (0.35, 0.7, 0.35, 1.0)
ORANGE: Color = (0.9, 0.55, 0.15, 1.0)

PAIR_ATTEMPTS = 2000
"""Random layouts before a `PlacementError`. The least likely one, two pulling blocks with
fixed orientations, is found in 1 of 30 attempts."""

BELOW_FLOOR_M = -0.05
"""Height of a body that has passed through the floor. The workspace bounds the tool from below; a
flat body that rests on the floor may be lower."""

SCALE_STEP = 0.02
"""Step of the scales between the ends of `object_scale_range`."""


@dataclass(frozen=True)
class TaskSettings:
    """The part of the environment's configuration that a task uses, with defaults filled in."""

    workspace: Workspace
    scale: float
    """Size of the objects as a multiple of their size at scale 1."""
    random_orientation: bool
    bounding_box_check: bool
    """Whether an object is inside the workspace if its bounding box is, instead of its centre."""
    action_limits: ActionLimits
    num_objects: int
    parameters: TaskParameters = field(default_factory=TaskParameters)
    """The task's own parameters, an instance of `Task.Parameters`."""


class Task(ABC):
    """Base of all tasks: bodies, their random poses, a goal, and an expert that reaches it.

    The constructor loads the bodies, once per world; every episode calls `initialize_episode`.
    Only `evaluate` tests the goal.

    Args:
        settings: the resolved configuration.
        world: not sealed yet.
        robot: loaded in this world.
        terrain: support surface of the objects; made by `make_terrain` if None.
    """

    version: ClassVar[int] = 0
    """Rises when episodes, observations or success change."""
    expert_version: ClassVar[int] = 0
    """Rises when the actions of the expert change."""
    control: ClassVar[Literal["open_loop", "close_loop"]]
    max_steps: ClassVar[int]
    """Default number of steps after which an episode is truncated."""
    workspace: ClassVar[Workspace]
    """Default workspace."""
    scale_range: ClassVar[tuple[float, float]]
    """Default range of the scale of the objects."""
    scale_limits: ClassVar[tuple[float, float]]
    """Allowed scales. Within them the fingers of every robot close on the objects, above the
    floor."""
    num_objects: ClassVar[int] = 1
    """Default number of objects."""
    num_objects_range: ClassVar[tuple[int, int]] = (1, 1)
    """Allowed numbers of objects."""
    num_objects_step: ClassVar[int] = 1
    """Difference between two allowed numbers of objects."""
    required_action_components: ClassVar[frozenset[str]] = frozenset()
    """Components of the action, as named by the action space, that every solution needs."""
    default_action_sequence: ClassVar[str | None] = None
    """Default `action_sequence`; None for the default of the control."""
    default_in_hand_mode: ClassVar[str] = "raw"
    """Default `in_hand_mode` in open loop."""
    default_in_hand_size: ClassVar[int] = 24
    """Default `in_hand_size`, pixels."""
    terminates_at_limit: ClassVar[bool] = False
    """Whether an episode that reaches the step limit is terminated instead of truncated."""
    fits_tray: ClassVar[bool] = False
    """Whether the objects fit the tray of `close_loop_tray`."""
    goal_vectors: ClassVar[Goal | None] = None
    """Success as a comparison of two vectors, for the task's ``-Goal`` id; None without such an
    id."""
    equal_moves: ClassVar[int] = 0
    """Open loop: largest number of commands of `expert_moves`; 0 if the expert gives its own
    alone."""

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
        """Load the support surface of the objects and return it; by default the floor."""
        return Flat(self.world, self.settings.workspace)

    @classmethod
    def step_limit(cls, num_objects: int) -> int:
        """Return the default number of steps after which an episode is truncated."""
        return cls.max_steps

    @abstractmethod
    def load_scene(self) -> None:
        """Load the bodies into `world`; called by the constructor."""

    def choose_objects(self, rng: np.random.Generator) -> None:  # noqa: B027 -- optional
        """Choose the objects of an episode, before the terrain and their poses are drawn.

        By default all objects are part of every episode.
        """

    @abstractmethod
    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Set new random poses of the bodies.

        Raises:
            PlacementError: the workspace is too small for them.
        """

    @abstractmethod
    def evaluate(self) -> dict[str, bool]:
        """Return the conditions of success in the present scene.

        Returns:
            Bools, also of NumPy or torch, named ``is_...``; success is their conjunction.
        """

    def progress(self) -> float:
        """Return how near the conditions of `evaluate` are, in [0, 1), for dense rewards.

        It depends on the present scene only. Tasks without this method have sparse rewards only.
        """
        raise NotImplementedError(f"{type(self).__name__} has no dense reward")

    @abstractmethod
    def expert_command(self) -> GripperCommand | PickPlaceCommand:
        """Return the expert's command; it depends on the present scene only."""

    @abstractmethod
    def instruction(self) -> str:
        """Return the goal of the present episode as an English sentence: "pick up the red block".

        It begins with a verb in lower case and has no full stop. Colours and numbers describe
        the objects.
        """

    @property
    @abstractmethod
    def objects(self) -> Sequence[Body]:
        """The bodies that must stay inside the workspace."""

    @property
    def landmarks(self) -> Sequence[YawPose]:
        """The poses in the vector observation; by default the objects'."""
        return [(body.position, body.yaw_rad) for body in self.objects]

    def conditions(self) -> dict[str, bool]:
        """Return the conditions of `evaluate` after a check of names and types.

        Raises:
            TypeError: there are none, or they are not bools whose names begin with ``is_``.
        """
        conditions, method = self.evaluate(), f"{type(self).__name__}.evaluate"
        are_named = isinstance(conditions, Mapping) and all(
            name.startswith("is_") and name != "is_success" for name in conditions
        )
        if not conditions or not are_named:
            raise TypeError(
                f"{method} must return bools whose names begin with 'is_', other than "
                f"'is_success', not {conditions}"
            )
        return {name: _as_bool(value, f"{method}: {name}") for name, value in conditions.items()}

    def is_success(self) -> bool:
        """Whether every condition of success holds."""
        return all(self.conditions().values())

    def is_valid(self) -> bool:
        """Whether every object is inside the workspace or held."""
        return not self.outside()

    def outside(self) -> list[str]:
        """Return which objects are outside the workspace and not held, each with axis and value."""
        held = self.robot.held_body()
        found = (self._outside(body) for body in self.objects if body is not held)
        return [text for text in found if text is not None]

    def is_valid_start(self) -> bool:
        """Whether an episode may start from the present scene."""
        return self.is_valid() and not self.is_success()

    @property
    def continues(self) -> bool:
        """Whether the next episode starts with the objects where they are."""
        return False

    def resume(self) -> None:  # noqa: B027 -- most tasks never continue
        """Start an episode with the objects where they are.

        Called instead of `initialize_episode` if `continues` holds, before the arm moves back.
        """

    def after_action(self) -> None:  # noqa: B027 -- most tasks have no events
        """Carry out events of the task, such as the arrival of an object.

        Called when the bodies are at rest after an action, before `evaluate` and the observation.
        """

    def get_state(self) -> Any:
        """Return the state of the task besides the poses of its bodies."""
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
        """Edge of a block at the scale of the task, metres."""
        return BLOCK_M * self.settings.scale

    @property
    def action_limits(self) -> ActionLimits:
        """Limits of the displacement and rotation of one action."""
        return self.settings.action_limits

    def _outside(self, body: Body) -> str | None:
        """Return along which axis a body is outside the workspace; None if it is inside."""
        if self.settings.bounding_box_check:
            lowest, highest = body.bounding_box()
        else:
            lowest = highest = body.position
        workspace = self.settings.workspace
        floor_m = min(workspace.z[0], BELOW_FLOOR_M)
        ranges = workspace.x, workspace.y, (floor_m, workspace.z[1])
        for axis, least, most, (low, high) in zip("xyz", lowest, highest, ranges, strict=True):
            if not low < least:
                return f"{body.name!r} at {axis} = {least:.4g} m, below {low:g} m"
            if not most < high:
                return f"{body.name!r} at {axis} = {most:.4g} m, above {high:g} m"
        return None

    # -- random poses ------------------------------------------------------------------------

    def random_point(self, rng: np.random.Generator, padding_m: float) -> tuple[float, float]:
        """Return a random point of the ground at least half of ``padding_m`` from the border."""
        return self.terrain.spawn_area.random_point(rng, padding_m)

    def random_yaw(self, rng: np.random.Generator, span_rad: float) -> float:
        """Return a random yaw from a range of ``span_rad`` about 0; 0 with fixed orientations."""
        if not self.settings.random_orientation:
            return 0.0
        return float(rng.uniform(-span_rad / 2, span_rad / 2))

    def stand(self, body: Body, xy: tuple[float, float], yaw_rad: float) -> None:
        """Place a body on the ground."""
        self.terrain.stand(body, xy, yaw_rad)


TASKS: Registry[type[Task]] = Registry("task", "ba_torchrl.tasks", Task)


class OpenLoopTask(Task):
    """A task whose actions are picks and places (appendix A.1, G.1).

    Without a z component in the action, `pick_height_m` and `place_height_m` return the height of
    the tool from ``top_m``, the highest point in a window around the target.
    """

    control = "open_loop"
    workspace = Workspace(x=(0.25, 0.65), y=(-0.2, 0.2), z=(0.0, 0.4))
    scale_range = (0.6, 0.6)
    scale_limits = (0.55, 1.1)
    finger_opening: ClassVar[float] = 1.0
    """Opening of the gripper before a pick, 0 to 1."""

    def expert_moves(self) -> Sequence[PickPlaceCommand]:
        """Return the command of `expert_command` first, then commands that are as good.

        With `equal_moves`, a policy is trained to choose any of them.
        """
        return [self.expert_command()]

    def lowest_tool_m(self, xy: tuple[float, float], rotation: Matrix | None = None) -> float:
        """Return the least height of the tool, metres, at which fingers close above the ground."""
        return self.terrain.lowest_tool_m(self.robot.gripper, xy, rotation)

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a pick without z, metres."""
        return max(top_m - self.block_m / 2, self.lowest_tool_m(xy))

    def place_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a place without z, metres."""
        return top_m + self.block_m / 2

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the square window around the target, metres."""
        return self.block_m / 2


class CloseLoopTask(Task):
    """A task whose actions are small displacements of the gripper (appendix A.2, G.2)."""

    control = "close_loop"
    max_steps = 50
    workspace = Workspace(x=(0.3, 0.6), y=(-0.15, 0.15), z=(0.01, 0.25))
    scale_range = (1.0, 1.0)
    scale_limits = (0.6, 1.2)

    def cube(self, color: Color = RED) -> Box:
        """Return the shape of a cubic block."""
        return Box(size_m=(self.block_m,) * 3, color=color)

    def random_pair(
        self, rng: np.random.Generator, paddings_m: tuple[float, float], distance_m: float
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return two random points of the ground at least ``distance_m`` apart.

        With fixed orientations both have the same x, so that a gripper that cannot turn can push an
        object from one to the other.

        Args:
            paddings_m: twice the least distance of each point from the border.
            distance_m: least distance between the points.

        Raises:
            PlacementError: the workspace is too small for them.
        """
        for _ in range(PAIR_ATTEMPTS):
            first, second = (self.random_point(rng, padding) for padding in paddings_m)
            if not self.settings.random_orientation:
                second = (first[0], second[1])
            if math.dist(first, second) >= distance_m:
                return first, second
        raise PlacementError(
            f"no room for two objects {distance_m:.3f} m apart: enlarge `workspace` or lower "
            "`object_scale_range`"
        )


class Versions(NamedTuple):
    """Versions of a task and of its expert."""

    task: int
    expert: int | None
    """None if it is not known."""

    def __str__(self) -> str:
        return f"task version {self.task}, expert version {self.expert}"


def versions_of(task_id: str) -> Versions:
    """Return the versions of a registered task and of its expert."""
    task_class = TASKS.entry(task_id)
    return Versions(task_class.version, task_class.expert_version)


def _as_bool(value: Any, what: str) -> bool:
    """Return a bool of Python, NumPy or torch, also as an array of one element, as Python's."""
    if type(value) is bool:
        return value
    array = np.asarray(value)
    if array.dtype != bool or array.size != 1:
        raise TypeError(f"{what} must be one bool, not {value!r}")
    return bool(array.item())
