"""Success of tasks as a comparison of two vectors, for learners that relabel goals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ba_torchrl.tasks.base import Task


@dataclass(frozen=True)
class Goal:
    """What a task's scene has achieved and what it should, as two vectors of one length.

    They agree with `Task.evaluate`, in which success is defined.

    Args:
        names: of the components; lengths are in metres.
        achieved: from the task to the first vector.
        desired: from the task to the second one.
        radius: the task's attribute that holds the distance below which the goal is reached; None
            if it is reached where no component is less than the desired one.
        landmarks: places in `Task.landmarks` of the goal, which learners get as ``desired`` only.
    """

    names: tuple[str, ...]
    achieved: Callable[[Task], Sequence[float]]
    desired: Callable[[Task], Sequence[float]]
    radius: str | None = None
    landmarks: tuple[int, ...] = ()

    def is_reached(self, task: type[Task], achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
        """Return whether goals [..., n] are reached, [...] bool."""
        if self.radius is None:
            return (achieved >= desired).all(-1)
        return np.linalg.norm(achieved - desired, axis=-1) < getattr(task, self.radius)


GOALS: dict[str, Goal] = {
    "close_loop/block_reaching": Goal(
        names=("tool x", "tool y", "tool z"),
        achieved=lambda task: task.robot.tool_pose()[0],
        desired=lambda task: task.block.position,
        radius="goal_distance_m",
        landmarks=(0,),
    ),
    "close_loop/block_pushing": Goal(
        names=("block x", "block y"),
        achieved=lambda task: task.block.position[:2],
        desired=lambda task: task.goal.position[:2],
        radius="goal_radius_m",
        landmarks=(1,),
    ),
    "close_loop/block_picking": Goal(
        names=("block is grasped", "tool z"),
        achieved=lambda task: (
            task.robot.held_body() is task.block,
            task.robot.tool_pose()[0][2],
        ),
        desired=lambda task: (1.0, task.lift_height_m),
    ),
}
"""By task. A module with a task of its own adds its goal before it registers the task."""
