"""A robot, a block and a static slab, level or tilted, on which the block lies."""

from __future__ import annotations

import math

import numpy as np
import pybullet

from ba_torchrl.sim.control.pick_place import PickPlace
from ba_torchrl.sim.geometry import Vector, rotation_array, tool_rotation
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import Physics, World
from ba_torchrl.tasks.terrain.flat import Flat
from ba_torchrl.tasks.workspace import Workspace

CUBE_M = (0.03, 0.03, 0.03)
LONG_M = (0.03, 0.12, 0.03)
SLAB_M = (0.2, 0.2, 0.02)
SLAB_CENTER_M = (0.5, 0.0, 0.06)
PHYSICS = Physics(time_step_s=1 / 240, solver_iterations=30)


class RampScene:
    """A block that lies flush on a slab, whose slope rises along y."""

    def __init__(
        self,
        *,
        teleport: bool = True,
        slope_rad: float = 0.0,
        size_m: Vector = CUBE_M,
        friction: float = 1.0,
        mass_kg: float = 0.1,
        robot: str = "kuka",
    ) -> None:
        self.world = World(PHYSICS)
        self.robot = ROBOTS[robot](self.world)
        self.block = self.world.add(Box(size_m=size_m, friction=friction, mass_kg=mass_kg), "block")
        self.slab = self.world.add(Box(size_m=SLAB_M, mass_kg=0.0), "slab")
        self.slope_rad = slope_rad
        self.turn = pybullet.getQuaternionFromEuler((slope_rad, 0.0, 0.0))
        self.normal = rotation_array(self.turn)[:, 2]
        self.slab.set_pose(SLAB_CENTER_M, self.turn)
        self.half_m = size_m[2] / 2
        self.world.seal()
        floor = Flat(self.world, Workspace((0.3, 0.6), (-0.15, 0.15), (0.01, 0.25)))
        self.hand = PickPlace(self.robot, floor, teleport=teleport)
        self.hand.reset()
        self.block.set_pose(self.above_slab(0.0), self.turn)
        self.world.settle()

    def above_slab(self, gap_m: float) -> Vector:
        """Return the centre of a block that is parallel to the slab at a distance from it."""
        return tuple(SLAB_CENTER_M + (SLAB_M[2] / 2 + gap_m + self.half_m) * self.normal)

    def pick(self, tilt_rad: Vector = (0.0, 0.0, 0.0), off_center_m: float = 0.0) -> None:
        """Pick the block at a distance from its centre along its y axis."""
        along = rotation_array(self.block.pose.orientation)[:, 1]
        self.hand.pick(tuple(self.block.position + off_center_m * along), tool_rotation(*tilt_rad))
        self.world.settle()
        self.hand.update_grasp()

    def set_finger_friction(self, friction: float) -> None:
        """Set the friction between fingers and block, without that between block and slab."""
        for link in frozenset.union(*self.robot.finger_links):
            pybullet.changeDynamics(
                self.robot.id, link, lateralFriction=friction, physicsClientId=self.world.client
            )

    def place(self, position: Vector, tilt_rad: Vector = (0.0, 0.0, 0.0)) -> None:
        """Release the block at a pose of the tool."""
        self.hand.place(position, tool_rotation(*tilt_rad))
        self.world.settle(max_steps=300)

    @property
    def is_held(self) -> bool:
        """Whether the gripper holds the block."""
        return self.hand.held is self.block

    @property
    def tilt_deg(self) -> float:
        """Tilt of the block, degrees."""
        return math.degrees(self.block.tilt_rad)

    @property
    def depth_m(self) -> float:
        """Depth of the deepest vertex of the block below the floor or the slab."""
        vertices = self.block.pose.apply(self.block.shape.vertices)
        slab = self.slab.pose.inverse().apply(vertices)
        is_over = (np.abs(slab[:, :2]) < np.array(SLAB_M[:2]) / 2).all(axis=1)
        into_slab = np.where(is_over, SLAB_M[2] / 2 - slab[:, 2], 0.0)
        return float(max(-vertices[:, 2].min(), into_slab.max()))
