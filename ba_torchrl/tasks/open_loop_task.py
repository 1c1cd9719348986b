"""What the open-loop tasks share."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, Literal

from ba_torchrl.actions import PickPlaceCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.tasks.base import BLOCK_M, Task, Workspace


class OpenLoopTask(Task):
    """A task of picks and places (appendix A.1, G.1)."""

    control: ClassVar[Literal["open_loop", "close_loop"]] = "open_loop"
    workspace = Workspace(x=(0.25, 0.65), y=(-0.2, 0.2), z=(0.0, 0.4))
    scale_range = (0.6, 0.6)
    scale_limits = (0.55, 1.1)
    finger_opening: ClassVar[float] = 1.0
    """How far the fingers open before a pick, 0 to 1."""

    @abstractmethod
    def expert_command(self) -> PickPlaceCommand:
        """Return what the expert does now; a function of the scene, from any state."""

    @property
    def lowest_pick_m(self) -> float:
        """Height of the tool, above the workspace's floor, at which fingers just clear the ground.

        A lower pick is raised to it.
        """
        return self.robot.gripper.lowest_tool_m() - self.settings.workspace.z[0]

    def pick_height_m(self, top_m: float) -> float:
        """Return the height of the tool for a pick, where an action leaves it open.

        Args:
            top_m: of the highest point around the target, above the workspace's floor.
        """
        return max(top_m - BLOCK_M * self.settings.scale / 2, self.lowest_pick_m)

    def place_height_m(self, top_m: float) -> float:
        """Return the height of the tool for a place, where an action leaves it open."""
        return top_m + BLOCK_M * self.settings.scale / 2

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the square that is searched for the highest point."""
        return BLOCK_M * self.settings.scale / 2
