"""Block Pulling: bring two flat blocks into contact (appendix A.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ba_torchrl.core.actions import GripperCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.contacts import gap_m
from ba_torchrl.sim.shapes import Box
from ba_torchrl.tasks.base import BLUE, RED, TASKS, CloseLoopTask
from ba_torchrl.tasks.instructions import colored
from ba_torchrl.tasks.manipulation.progress_terms import nearness, staged
from ba_torchrl.tasks.manipulation.pushing import (
    STANDOFF_M,
    Push,
    behind_point,
    has_room_behind,
    reach_behind,
)

NO_ROOM_COST_M = 1.0
"""Cost of a block with no room behind it for the gripper."""

FARTHEST_M = 2.0
"""Distance up to which the gap between the blocks is measured."""

PRESS_M = 5e-3
"""Distance that a pull continues after the blocks touch, if it must not push the other block."""


@TASKS.register("close_loop/block_pulling")
class BlockPulling(CloseLoopTask):
    """Objects: two blocks of 8 x 8 x 5 cm.

    Goal: the blocks touch. The episode ends early when a block leaves the workspace.
    Paper, appendix A.2.
    """

    scale_limits = (0.6, 1.1)

    def load_scene(self) -> None:
        """Load the blocks."""
        size = tuple(edge * self.settings.scale for edge in (0.08, 0.08, 0.05))
        self.blocks = [
            self.world.add(Box(size_m=size, mass_kg=0.5, color=color), name)
            for color, name in ((RED, "first block"), (BLUE, "second block"))
        ]

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place the blocks at least 13.6 cm apart; with fixed orientations, on a line along y."""
        spacing = 3.4 * 0.04 * self.settings.scale
        points = self.random_pair(rng, (spacing, spacing), spacing)
        for block, xy in zip(self.blocks, points, strict=True):
            self.stand(block, xy, self.random_yaw(rng, math.pi))

    def evaluate(self) -> dict[str, bool]:
        """Return whether the blocks touch."""
        return {"is_touching": self.blocks[0].touches(self.blocks[1])}

    def instruction(self) -> str:
        """Return the instruction with the blocks' colours."""
        first, second = (colored(block, "block") for block in self.blocks)
        return f"pull the {first} and the {second} together"

    def progress(self) -> float:
        """Return the progress in two stages: reach behind either block, and gap between both."""
        first, second = self.blocks
        reaches = (
            reach_behind(self.robot, body, other.position[:2], self.settings.workspace)
            for body, other in ((first, second), (second, first))
        )
        gap = gap_m(self.world.client, first.id, second.id, FARTHEST_M)
        return staged(max(reaches), nearness(gap))

    def expert_command(self) -> GripperCommand:
        """Move behind the block with the lower cost and pull it to the other."""
        pulled, other = min(
            (tuple(self.blocks), tuple(reversed(self.blocks))), key=lambda pair: self._cost(*pair)
        )
        return Push(
            self.robot,
            pulled,
            other.position[:2],
            workspace=self.settings.workspace,
            limits=self.action_limits,
            opening=0.5,  # a corner of the block would fit between fully open fingers
            stop_short_m=self._stop_short_m(pulled, other),
        ).command()

    def _stop_short_m(self, pulled: Body, other: Body) -> float:
        """Return the distance before the other block's centre at which the pull ends.

        If the outlines must stay in the workspace, an action ends where the blocks touch: a longer
        one could push the other block across the border.
        """
        if not self.settings.bounding_box_check:
            return 0.0
        travel_m = (
            gap_m(self.world.client, self.robot.id, pulled.id)
            + gap_m(self.world.client, pulled.id, other.id)
            + PRESS_M
        )
        return max(math.dist(self.robot.tool_pose()[0][:2], other.position[:2]) - travel_m, 0.0)

    def _cost(self, pulled: Body, other: Body) -> float:
        """Return the distance to the start of the pull, plus a cost for a start near the border.

        The distance decreases on the approach, so the choice of the block does not change.
        """
        (px, py, _), (ox, oy, _) = pulled.position, other.position
        length = math.hypot(ox - px, oy - py) or 1.0
        direction = ((ox - px) / length, (oy - py) / length)
        start = behind_point(self.robot, pulled, direction, self.settings.workspace)
        missing_m = STANDOFF_M - math.dist(start, (px, py))
        cost_m = math.dist(start, self.robot.tool_pose()[0][:2]) + 2 * missing_m
        return cost_m if has_room_behind(self.robot, pulled, start) else cost_m + NO_ROOM_COST_M

    @property
    def objects(self) -> Sequence[Body]:
        """Both blocks."""
        return self.blocks
