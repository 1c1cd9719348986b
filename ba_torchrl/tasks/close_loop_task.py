"""Base of the close-loop tasks."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np

from ba_torchrl.errors import PlacementError
from ba_torchrl.sim.shapes import Box, Color
from ba_torchrl.tasks.base import BLOCK_M, Task
from ba_torchrl.tasks.colors import RED
from ba_torchrl.tasks.workspace import Workspace

PAIR_ATTEMPTS = 2000
"""Random layouts before a `PlacementError`. The least likely one, that of two pulling blocks with
fixed orientations, is found in 1 of 30 attempts."""


class CloseLoopControl:
    """Defaults of close-loop control (appendix A.2, G.2); a mixin of `Task`."""

    control: ClassVar[Literal["open_loop", "close_loop"]] = "close_loop"
    max_steps = 50
    workspace = Workspace(x=(0.3, 0.6), y=(-0.15, 0.15), z=(0.01, 0.25))
    scale_range = (1.0, 1.0)
    scale_limits = (0.6, 1.2)


class CloseLoopTask(CloseLoopControl, Task):
    """A task whose actions are small displacements of the gripper (appendix A.2, G.2)."""

    def cube(self, color: Color = RED) -> Box:
        """Return the shape of a cubic block."""
        edge = BLOCK_M * self.settings.scale
        return Box(size_m=(edge, edge, edge), color=color)

    def random_pair(
        self, rng: np.random.Generator, paddings_m: tuple[float, float], distance_m: float
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return two random points of the ground at least ``distance_m`` apart.

        With fixed orientations both have the same x, so that a gripper that cannot turn can push an
        object from one to the other.

        Args:
            rng: random generator.
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
