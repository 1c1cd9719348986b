"""Straight paths of a tool that points straight down, and their time scaling."""

from __future__ import annotations

import math

from ba_torchrl.actions import wrap_angle
from ba_torchrl.sim.geometry import Vector, YawPose, downward
from ba_torchrl.sim.robots.base import Robot


class Path:
    """A straight line of the tool point with a proportional rotation about the vertical.

    Args:
        robot: the robot.
        start: position and yaw of the tool at the start.
        end: position and yaw of the tool at the end.
    """

    def __init__(self, robot: Robot, start: YawPose, end: YawPose) -> None:
        self._robot = robot
        self._start, self._start_yaw = start
        self._rotation_rad = wrap_angle(end[1] - start[1])
        self.angle_rad = abs(self._rotation_rad)
        self._set_delta(tuple(e - s for s, e in zip(self._start, end[0], strict=True)))

    def _set_delta(self, delta: Vector) -> None:
        self._delta = delta
        self.length_m = math.hypot(*delta)
        self.goes_down = delta[2] < -1e-4
        self.goes_up = delta[2] > 1e-4

    def yield_to(self, direction: Vector, fraction: float, distance_m: float) -> None:
        """Displace the rest of the path, and remove its motion against the displacement.

        Args:
            direction: of the displacement: horizontal and vertical unit vectors, or zeros.
            fraction: of the path that has been covered.
            distance_m: length of the displacement.
        """
        x, y, z = self._robot.tool_pose()[0]
        dx, dy, dz = self._delta
        away_x, away_y, up = direction
        against, down = min(dx * away_x + dy * away_y, 0.0), min(dz * up, 0.0)
        delta = dx - against * away_x, dy - against * away_y, dz - down * up
        tool = x + distance_m * away_x, y + distance_m * away_y, z + distance_m * up
        self._start = tuple(t - fraction * d for t, d in zip(tool, delta, strict=True))
        self._set_delta(delta)

    def remaining_m(self, fraction: float) -> float:
        """Return the length of the rest of the path, metres."""
        return (1 - fraction) * self.length_m

    def joints_at(self, fraction: float) -> list[float] | None:
        """Return the arm joints at a fraction of the path, 0 to 1; None if out of reach."""
        x, y, z = (s + fraction * d for s, d in zip(self._start, self._delta, strict=True))
        rotation = downward(self._start_yaw + fraction * self._rotation_rad)
        return self._robot.inverse_kinematics((x, y, z), rotation, self._robot.joints)


def quintic_time_scaling(u: float) -> float:
    """Return the quintic polynomial from 0 to 1 with zero velocity and acceleration at both ends.

    Args:
        u: fraction of the duration, 0 to 1.
    """
    return u * u * u * (10 - 15 * u + 6 * u * u)
