"""Simulator faults: how they are detected and counted.

A fault is an error of PyBullet or of its connection, a pose or an observation that is not finite,
or a body that passed through the floor or was thrown away. In a step, it ends the episode
truncated, and the next reset builds a new world. In a reset, the episode starts again in a new
world. Any other error comes from the code, such as a task's, and is raised. Faults of many
episodes in a row are taken for an error of the code as well.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping

import torch
from tensordict import NonTensorData

from ba_torchrl.core.errors import RepeatedFaultError, SimulationError
from ba_torchrl.envs.scene import Scene

logger = logging.getLogger(__name__)

MAX_CONSECUTIVE_FAULTS = 10
"""Number of disturbed episodes, without an undisturbed one in between, that ends a run."""
LOWEST_M = -0.1
"""Height below which a body has passed through the floor."""
FARTHEST_M = 10.0
"""Distance from the robot's base that only a diverging solver gives a body within one step."""


def check_bodies(scene: Scene, *, may_be_lost: bool = False) -> None:
    """Raise `SimulationError` unless the state of a scene is one that the physics engine can
    continue from.

    Args:
        may_be_lost: check only that poses and joint angles are finite.
    """
    if not math.isfinite(sum(scene.robot.measured_joints())):
        raise SimulationError("a joint of the robot is not finite")
    for body in scene.world.moving_bodies:
        if body.is_inactive:
            continue
        position, orientation = body.pose
        if not math.isfinite(sum(position) + sum(orientation)):
            raise SimulationError(f"the pose of {body.name!r} is not finite")
        is_lost = position[2] < LOWEST_M or math.hypot(*position) > FARTHEST_M
        if is_lost and not (body.is_hidden or may_be_lost):
            place = ", ".join(f"{x:.3g}" for x in position)
            raise SimulationError(f"{body.name!r} is lost at ({place}) m")


def check_observation(observation: Mapping[str, torch.Tensor | NonTensorData]) -> None:
    """Check that the entries of an observation are finite."""
    for key, value in observation.items():
        if (
            isinstance(value, torch.Tensor)
            and value.is_floating_point()
            and not math.isfinite(value.sum())
        ):
            raise SimulationError(f"the observation {key!r} is not finite")


class DisturbedEpisodes:
    """Counts the episodes with a fault since the last undisturbed one."""

    def __init__(self) -> None:
        self.in_a_row = 0
        self._is_undisturbed = False
        """Whether the episode has steps and no fault."""

    def count_step(self) -> None:
        """Note a step without a fault."""
        self._is_undisturbed = True

    def count_reset(self) -> None:
        """Note the end of an episode, however long it was."""
        if self._is_undisturbed:
            self.in_a_row = 0
        self._is_undisturbed = False

    def count_fault(self) -> None:
        """Note a fault, which ends the episode."""
        self.in_a_row += 1
        self._is_undisturbed = False


class FaultCounter:
    """Counts the faults of an environment, and ends it after too many in a row."""

    def __init__(self, task_id: str) -> None:
        self._task_id = task_id
        self.total = 0
        self.episodes = DisturbedEpisodes()

    def count_fault(self, error: Exception) -> None:
        """Count and log an error, which is being handled.

        Raises:
            RepeatedFaultError: it is the last of `MAX_CONSECUTIVE_FAULTS` without an undisturbed
                episode.
        """
        self.total += 1
        self.episodes.count_fault()
        logger.exception("%s: simulator fault %d, episode dropped", self._task_id, self.total)
        if self.episodes.in_a_row >= MAX_CONSECUTIVE_FAULTS:
            raise RepeatedFaultError(
                f"{self._task_id} failed {self.episodes.in_a_row} times in a row, without an "
                f"undisturbed episode; the last time: {type(error).__name__}: {error}"
            ) from error
