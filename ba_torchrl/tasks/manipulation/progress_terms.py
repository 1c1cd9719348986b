"""Terms of the tasks' `progress`: from 0 to 1, continuous, and 1 where a stage is complete."""

from __future__ import annotations

import math
from collections.abc import Iterable

from ba_torchrl.core.actions import wrap_angle
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.robots.base import Robot

MOST = 0.9
"""Progress of a state in which all stages are complete; a success has the reward 1."""
LENGTH_M = 0.15
"""Distance at which `nearness` is 0.24."""
TURN_M = 0.03
"""Distance that counts as much as a yaw error of one radian: fingertips are this far off the tool
point."""
CLOSED_M = 0.03
"""Distance that counts as much as closed fingers where open ones move around a body. Closed ones
stop on top of it."""


def staged(*stages: float) -> float:
    """Return the progress of a task: `MOST` times the mean of its stages, each 0 to 1."""
    return MOST * sum(stages) / len(stages)


def nearness(distance_m: float) -> float:
    """Return 1 - tanh(d / `LENGTH_M`), which is 1 for a distance of zero or less."""
    return 1.0 - math.tanh(max(distance_m, 0.0) / LENGTH_M)


def share(value: float, start: float, end: float) -> float:
    """Return the part of the way from ``start`` to ``end``, 0 before it and 1 beyond it."""
    return min(max((value - start) / (end - start), 0.0), 1.0)


def turn_m(robot: Robot, yaws_rad: Iterable[float]) -> float:
    """Return the gripper's smallest yaw error, turned into metres by `TURN_M`.

    Args:
        yaws_rad: yaws of the gripper; one suffices, and half a turn makes no difference.
    """
    yaw = robot.tool_pose()[1]
    return TURN_M * min(abs(wrap_angle(wanted - yaw, math.pi)) for wanted in yaws_rad)


def reach(
    robot: Robot, body: Body, yaws_rad: Iterable[float] | None = None, within_m: float = 0.0
) -> float:
    """Return the nearness of the tool point, with open fingers, to the centre of a body.

    Args:
        yaws_rad: yaws of the gripper at which the fingers close on the body; None for any.
        within_m: distance that counts as none.
    """
    distance_m = max(math.dist(robot.tool_pose()[0], body.position) - within_m, 0.0)
    distance_m += CLOSED_M * (1 - robot.opening())
    return nearness(distance_m + (0.0 if yaws_rad is None else turn_m(robot, yaws_rad)))


def lift_height(robot: Robot, low_m: float, high_m: float) -> float:
    """Return the height of the tool as a part of the way from ``low_m`` to ``high_m``."""
    return share(robot.tool_pose()[0][2], low_m, high_m)
