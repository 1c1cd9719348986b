"""Open-loop commands from poses in SE(3)."""

from __future__ import annotations

from ba_torchrl.actions import PICK, PLACE, PickPlaceCommand
from ba_torchrl.sim.geometry import Pose, tool_angles
from ba_torchrl.tasks.workspace import Workspace

LEVEL_RAD = 0.02
"""A tool that leans less than this points straight down: the home pose leans by up to 1e-3."""
ROUNDING_RAD = 1e-9
"""A yaw this small is zero: rounded below it, it would wrap to half a turn."""
NO_OP_Z_M = 0.1
"""Height of the tool, where nothing is."""


def pick_command(tool: Pose) -> PickPlaceCommand:
    """Return the pick with the tool at a pose."""
    return _command(PICK, tool)


def place_command(tool: Pose, held: Pose, target: Pose) -> PickPlaceCommand:
    """Return the place that brings what is held to a pose.

    Args:
        tool: pose of the tool now.
        held: pose of what is held now.
        target: pose of what is held as it is let go.
    """
    return _command(PLACE, carrying_pose(tool, held, target))


def carrying_pose(tool: Pose, held: Pose, target: Pose) -> Pose:
    """Return the pose of the tool that brings what it holds to a pose.

    Args:
        tool: pose of the tool now.
        held: pose of what is held now.
        target: wanted pose of what is held.
    """
    return target.compose(held.inverse().compose(tool))


def no_op(workspace: Workspace, is_holding: bool) -> PickPlaceCommand:
    """Return a command that changes nothing: there is nothing left to do.

    Args:
        workspace: a pick from its corner, where nothing is, changes nothing.
        is_holding: whether something is held; then it is put down there.
    """
    primitive = PLACE if is_holding else PICK
    return PickPlaceCommand(primitive, workspace.x[0], workspace.y[0], NO_OP_Z_M)


def _command(primitive: int, tool: Pose) -> PickPlaceCommand:
    """Return the command with the tool at a pose."""
    rz, ry, rx = tool_angles(tool.orientation)
    rz = 0.0 if abs(rz) < ROUNDING_RAD else rz
    ry, rx = (0.0 if abs(angle) < LEVEL_RAD else angle for angle in (ry, rx))
    return PickPlaceCommand(primitive, *tool.position, rz, ry, rx)
