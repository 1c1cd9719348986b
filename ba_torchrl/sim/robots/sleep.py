"""A robot at rest that is not simulated while bodies settle."""

from __future__ import annotations

from collections.abc import Callable

import pybullet

from ba_torchrl.sim.activation import set_asleep
from ba_torchrl.sim.contacts import contacts
from ba_torchrl.sim.robots.base import Robot

REST_JOINT_RAD = 1e-3
"""Largest deviation from the commanded joints, and largest velocity (rad/s), of an arm at rest."""
REST_OPENING = 1e-3
"""Largest deviation from the commanded opening of fingers at rest."""


class RobotSleep:
    """Puts a robot at rest into Bullet's sleeping state, in which its joints are not simulated.

    Bodies that do not touch the robot move as they do beside one that is awake, except for the
    number of solver iterations where a residual ends them early. Bullet simulates a
    sleeping robot again as soon as a moving body touches it.

    Args:
        robot: the robot.
        is_empty: returns whether the gripper holds nothing.
    """

    def __init__(self, robot: Robot, is_empty: Callable[[], bool]) -> None:
        self.robot = robot
        self.is_empty = is_empty

    def is_possible(self) -> bool:
        """Whether the robot holds and touches nothing and is at rest where it is commanded to."""
        if not self.is_empty():
            return False
        robot = self.robot
        states = pybullet.getJointStates(robot.id, robot.arm_joints, physicsClientId=robot.client)
        return (
            all(
                abs(state[0] - joint) < REST_JOINT_RAD and abs(state[1]) < REST_JOINT_RAD
                for state, joint in zip(states, robot.joints, strict=True)
            )
            and abs(robot.opening() - robot.commanded_opening) < REST_OPENING
            and not contacts(robot.client, robot.id)
        )

    def set_asleep(self, is_asleep: bool) -> None:
        """Set the state, which takes effect at the end of the next physics step."""
        set_asleep(self.robot.client, self.robot.id, is_asleep)
