"""The command that undoes a pick or a place."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from ba_torchrl.actions import PickPlaceCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import ORIGIN, Matrix, Pose, tool_rotation
from ba_torchrl.tasks.manipulation.commands import pick_command, place_command

LowestToolHeight = Callable[[tuple[float, float], Matrix], float]
"""Function of x and y of the tool and its rotation, which returns its least height."""

MOVED_M = 5e-3
"""Largest displacement of a body that counts as unmoved."""


class UndoRecorder(NamedTuple):
    """The scene before an action, from which the command that undoes the action follows."""

    poses: Mapping[Body, Pose]
    held: Body | None
    grasp: Pose | None
    """Pose of the held body in the frame of the tool."""

    @classmethod
    def record(cls, bodies: Sequence[Body], held: Body | None, grasp: Pose | None) -> UndoRecorder:
        """Return a recorder of the present scene.

        Args:
            bodies: the bodies that an action may move.
            held: the body in the gripper.
            grasp: pose of the held body in the frame of the tool.
        """
        return cls({body: body.pose for body in bodies}, held, grasp)

    def undo_command(
        self,
        held: Body | None,
        grasp: Pose | None,
        lowest_tool_m: LowestToolHeight = lambda xy, rotation: -math.inf,
    ) -> PickPlaceCommand | None:
        """Return the command that undoes the action since the recording.

        A pick is undone by a place at the pose from which the body was picked, a place by a pick at
        the pose where the body came to rest. Both use the grasp of the body, so the tool pose
        differs from that of the action if the body slipped or settled.

        Args:
            held: the body in the gripper now.
            grasp: pose of the held body in the frame of the tool now.
            lowest_tool_m: returns for x and y and the rotation of the tool its least height for a
                pick, metres.

        Returns:
            None if the action neither picked nor placed a body, or moved another body.
        """
        if (self.held is None) == (held is None):
            return None
        body = held if self.held is None else self.held
        for other, (before, _) in self.poses.items():
            if other is not body and math.dist(before, other.position) > MOVED_M:
                return None
        if self.held is None:
            return place_command(Pose(ORIGIN), grasp, self.poses[body])
        command = pick_command(body.pose.compose(self.grasp.inverse()))
        lowest_m = lowest_tool_m((command.x_m, command.y_m), tool_rotation(*command.angles_rad))
        return command._replace(z_m=max(command.z_m, lowest_m))
