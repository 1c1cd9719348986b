"""Simulated motions of the tool in open-loop control."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.contacts import Contact, nearest_points, outer_contacts, vertical_force_n
from ba_torchrl.sim.control.limits import PickPlaceLimits
from ba_torchrl.sim.control.paths import quintic_time_scaling
from ba_torchrl.sim.geometry import Matrix, Vector
from ba_torchrl.sim.robots.base import Robot

PEAK_ACCELERATION = 10 / math.sqrt(3)
"""Greatest acceleration of `quintic_time_scaling` for a unit distance and a unit duration."""


class ToolMotion:
    """Simulates straight and joint-space motions with quintic time scaling.

    Args:
        robot: the robot.
        limits: accelerations, forces and step counts.
    """

    def __init__(self, robot: Robot, limits: PickPlaceLimits) -> None:
        self.robot = robot
        self.world = robot.world
        self.limits = limits

    def move_straight(
        self,
        start: Vector,
        end: Vector,
        rotation: Matrix,
        held: Body | None,
        count: int | None = None,
    ) -> None:
        """Simulate a straight motion of the tool.

        The motion ends where it is out of reach, or, if downward, at the force limit.

        Args:
            start: position of the tool point at the start, metres.
            end: position of the tool point at the end, metres.
            rotation: of the tool.
            held: the held body.
            count: number of physics steps; None means the least within the acceleration limits.
        """
        limits = self.limits
        if count is None:
            acceleration = limits.acceleration_m_s2
            if held is not None:
                acceleration = limits.held_acceleration_m_s2
            count = max(
                limits.min_motion_steps, self._num_steps(math.dist(start, end), acceleration)
            )
        goes_down = end[2] < start[2]
        for i in range(1, count + 1):
            fraction = quintic_time_scaling(i / count)
            point = tuple(s + fraction * (e - s) for s, e in zip(start, end, strict=True))
            joints = self.robot.inverse_kinematics(point, rotation, self.robot.joints)
            if joints is None:
                return
            before = self.robot.joints
            self.robot.command(joints)
            self.world.step()
            if (
                goes_down
                and vertical_force_n(self.outer_contacts(held)) > limits.max_vertical_force_n
            ):
                self.robot.command(before)
                self.world.step()
                return

    def move_joints(self, joints: Sequence[float], held: Body | None) -> None:
        """Simulate a joint-space motion of the arm.

        Args:
            joints: target, radians.
            held: the held body.
        """
        start = self.robot.joints
        deltas = [e - s for s, e in zip(start, joints, strict=True)]
        limits = self.limits
        acceleration = (
            limits.joint_acceleration_rad_s2
            if held is None
            else limits.held_joint_acceleration_rad_s2
        )
        count = max(2, self._num_steps(max(map(abs, deltas)), acceleration))
        for i in range(1, count + 1):
            fraction = quintic_time_scaling(i / count)
            self.robot.command([s + fraction * d for s, d in zip(start, deltas, strict=True)])
            self.world.step()

    def outer_contacts(self, held: Body | None) -> list[Contact]:
        """Return the contacts of the hand and the held body with other bodies."""
        held_ids = () if held is None else (held.id,)
        return outer_contacts(self.world.client, self.robot.id, *held_ids)

    def is_clear(self, held: Body | None) -> bool:
        """Whether hand and held body are clear of all other bodies at their current poses.

        This computes closest points instead of contact points: those of bodies that penetrate each
        other affect later steps through caches of the engine that no saved state contains.

        Args:
            held: the held body.
        """
        client, robot = self.world.client, self.robot
        own = [robot.id] if held is None else [robot.id, held.id]
        others = {self.world.floor, *(body.id for body in self.world.bodies)} - {*own}
        return not any(
            point.body_id != robot.id or point.link not in robot.non_colliding_links
            for body_id in own
            for other_id in sorted(others)
            for point in nearest_points(client, body_id, other_id, self.limits.contact_margin_m)
        )

    def _num_steps(self, length: float, acceleration: float) -> int:
        """Return the least number of steps of a quintic motion within an acceleration limit."""
        duration_s = math.sqrt(PEAK_ACCELERATION * length / acceleration)
        return math.ceil(duration_s / self.world.physics.time_step_s)
