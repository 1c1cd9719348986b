"""Base of the open-loop tasks."""

from __future__ import annotations

from typing import ClassVar, Literal

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Matrix
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.base import BLOCK_M, Task, TaskSettings
from ba_torchrl.tasks.terrain import Terrain
from ba_torchrl.tasks.workspace import Workspace


class OpenLoopControl:
    """Defaults of open-loop control, and heights of picks and places (appendix A.1, G.1).

    A mixin of `Task`. Without a z component in the action, `pick_height_m` and `place_height_m`
    return the height of the tool from the highest point in a window around the target.
    """

    control: ClassVar[Literal["open_loop", "close_loop"]] = "open_loop"
    workspace = Workspace(x=(0.25, 0.65), y=(-0.2, 0.2), z=(0.0, 0.4))
    scale_range = (0.6, 0.6)
    scale_limits = (0.55, 1.1)
    finger_opening: ClassVar[float] = 1.0
    """Opening of the gripper before a pick, 0 to 1."""

    settings: TaskSettings
    robot: Robot
    terrain: Terrain

    def lowest_tool_m(self, xy: tuple[float, float], rotation: Matrix | None = None) -> float:
        """Return the least height of a pick, at which the fingers close above the ground, metres.

        Args:
            xy: position of the tool, metres.
            rotation: rotation of the tool; None if it points down.
        """
        return self.terrain.lowest_tool_m(self.robot.gripper, xy, rotation)

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a pick without z, metres.

        Args:
            top_m: height of the highest point in the window around the target.
            xy: position of the target.
        """
        return max(top_m - BLOCK_M * self.settings.scale / 2, self.lowest_tool_m(xy))

    def place_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a place without z, metres.

        Args:
            top_m: height of the highest point in the window around the target.
            xy: position of the target.
        """
        return top_m + BLOCK_M * self.settings.scale / 2

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the square window around the target, metres.

        Args:
            held: the body in the gripper.
        """
        return BLOCK_M * self.settings.scale / 2


class OpenLoopTask(OpenLoopControl, Task):
    """A task whose actions are picks and places (appendix A.1, G.1)."""
