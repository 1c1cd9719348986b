"""The base of the open-loop tasks."""

from __future__ import annotations

from typing import ClassVar, Literal

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.tasks.base import BLOCK_M, Task, TaskSettings
from ba_torchrl.tasks.terrain import Terrain
from ba_torchrl.tasks.workspace import Workspace


class OpenLoopControl:
    """Defaults of open-loop control, and heights of picks and places (appendix A.1, G.1).

    A mixin of `Task`: `pick_height_m`, `place_height_m` and `window_m` give the height of the tool
    where an action has no z component.
    """

    control: ClassVar[Literal["open_loop", "close_loop"]] = "open_loop"
    workspace = Workspace(x=(0.25, 0.65), y=(-0.2, 0.2), z=(0.0, 0.4))
    scale_range = (0.6, 0.6)
    scale_limits = (0.55, 1.1)
    finger_opening: ClassVar[float] = 1.0
    """Opening of the fingers before a pick, 0 to 1."""

    settings: TaskSettings
    robot: Robot
    terrain: Terrain

    def lowest_tool_m(self, xy: tuple[float, float]) -> float:
        """Return the least height of the tool at which the fingers close above the ground.

        A lower pick is raised to it.
        """
        return self.terrain.lowest_tool_m(self.robot.gripper, xy)

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a pick, metres.

        Args:
            top_m: height of the highest point around the target.
            xy: of the target.
        """
        return max(top_m - BLOCK_M * self.settings.scale / 2, self.lowest_tool_m(xy))

    def place_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a place, metres; arguments as for `pick_height_m`."""
        return top_m + BLOCK_M * self.settings.scale / 2

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the square that is searched for the highest point, metres."""
        return BLOCK_M * self.settings.scale / 2


class OpenLoopTask(OpenLoopControl, Task):
    """A task of picks and places (appendix A.1, G.1)."""
