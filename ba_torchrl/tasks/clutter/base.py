"""A heap of objects in a tray, which persists over several episodes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from pydantic import Field

from ba_torchrl.core.config import LocalPath, TaskParameters
from ba_torchrl.sim.assets.base import load_object_set
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import YawPose, downward
from ba_torchrl.sim.vision.depth import HeightCamera
from ba_torchrl.tasks.base import Task
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.clutter.grasp_planner import GraspPlanner
from ba_torchrl.tasks.instructions import counted
from ba_torchrl.tasks.terrain.tray import Tray

DROP_Z_M = 0.2
"""Height from which objects are dropped."""
DROP_INTERVAL_S = 0.15
"""Time between two drops, in which an object falls 11 cm and clears the next one's start."""
DROP_MARGIN_M = 0.03
"""Least distance between the start of a drop and the edge of the tray's floor."""
SETTLE_S = 4.0
"""Time limit for the objects to come to rest."""
DROP_ATTEMPTS = 3
"""Heaps that are dropped until one comes to rest within the time limit."""

RETREAT_Z_M = (0.55, 0.5, 0.45, 0.4, 0.35)
"""Heights of the tool during the drop; the first with a solution of the inverse kinematics."""


class ClutterTask(Task):
    """A task of grasping an object from a heap, in which the next episode continues with the rest.

    New objects are dropped when the tray is empty, when an object has left the workspace, and after
    ``max_attempts`` episodes with the same heap; an episode that is reset early counts. In
    the appendix, a heap with remaining objects is never replaced; the reference implementation
    replaces it in these cases, and its number of attempts is the default.
    """

    scale_limits = (1.0, 1.0)

    class Parameters(TaskParameters):
        """The objects of the heap."""

        object_set: str = "random"
        """Name of the object set; see `ba_torchrl.sim.assets`."""
        asset_root: LocalPath | None = None
        """Folder of an object set that is not part of the package."""
        max_attempts: int | None = Field(default=None, ge=1)
        """Episodes with the same heap after which new objects are dropped; None for the reference
        implementation's limit: 30 in open loop, and 1.5 per object, rounded up, in close loop."""

    @abstractmethod
    def default_max_attempts(self) -> int:
        """Return the number of episodes with the same heap after which it is replaced."""

    @abstractmethod
    def grasped_object(self) -> Body | None:
        """Return the object that this episode has grasped, if any."""

    def load_scene(self) -> None:
        """Load all objects of the object set."""
        parameters = self.settings.parameters
        self.attempts = 0
        """Episodes with the present heap that have ended."""
        self.max_attempts = parameters.max_attempts
        if self.max_attempts is None:
            self.max_attempts = self.default_max_attempts()
        shapes = load_object_set(parameters.object_set, parameters.asset_root)
        copies = -(-self.settings.num_objects // len(shapes))
        numbers = [f" {copy + 1}" if copies > 1 else "" for copy in range(copies)]
        self.pool = BodyPool(
            self.world,
            [shape for _ in numbers for shape in shapes],
            [f"{name}{number}" for number in numbers for name in shapes.names],
        )

    def make_terrain(self) -> Tray:
        """Load the tray and return it."""
        return Tray(self.world, self.settings.workspace)

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Drop new objects into the tray one by one until they are at rest.

        They start with random orientations, or with the identity if orientations are fixed, and
        tumble as they hit the tray and each other.
        """
        self.attempts = 0
        settings, world, pool = self.settings, self.world, self.pool
        center = np.array(settings.workspace.center)
        half_m = self.terrain.half_m
        count = settings.num_objects
        joints = self.robot.joints
        self._retreat()
        pause = round(DROP_INTERVAL_S / world.physics.time_step_s)
        for _ in range(DROP_ATTEMPTS):
            pool.clear()
            chosen = rng.choice(len(pool.bodies), size=count, replace=False)
            bodies = [pool.bodies[i] for i in chosen]
            for body in bodies:
                x, y = center + rng.uniform(DROP_MARGIN_M - half_m, half_m - DROP_MARGIN_M, 2)
                orientation = (0.0, 0.0, 0.0, 1.0)
                if settings.random_orientation:  # uniform over SO(3)
                    quaternion = rng.normal(size=4)
                    orientation = tuple((quaternion / np.linalg.norm(quaternion)).tolist())
                pool.activate(body)
                body.set_pose((x, y, DROP_Z_M), orientation)
                world.step(pause)
            if world.settle(round(SETTLE_S / world.physics.time_step_s)):
                break
        self.robot.teleport(joints)

    def _retreat(self) -> None:
        """Move the arm to the highest pose above the heap that it can reach."""
        robot, center_xy = self.robot, self.settings.workspace.center
        solutions = (robot.inverse_kinematics((*center_xy, z), downward(0.0)) for z in RETREAT_Z_M)
        joints = next((found for found in solutions if found is not None), robot.joints)
        robot.teleport(joints)

    @property
    def continues(self) -> bool:
        remaining = len(self.pool.active) - (self.grasped_object() is not None)
        return remaining > 0 and self.attempts + 1 < self.max_attempts

    def resume(self) -> None:
        """Count an attempt, and remove the grasped object from the scene."""
        grasped_object = self.grasped_object()
        self.attempts += 1
        if grasped_object is not None:
            self.pool.deactivate(grasped_object)

    @cached_property
    def planner(self) -> GraspPlanner:
        """The grasp planner of the expert, made at its first use."""
        camera = HeightCamera(self.world.bodies)
        return GraspPlanner(self.pool.bodies, camera, self.settings.workspace, self.robot.gripper)

    def instruction(self) -> str:
        """Return the instruction with the number of objects that are left."""
        count = len(self.objects)
        number = "one of " if count > 1 else ""
        return f"pick up {number}the {counted(count, 'object')} in the tray"

    @property
    def objects(self) -> Sequence[Body]:
        """The objects in the tray, and the grasped one."""
        return self.pool.active

    @property
    def landmarks(self) -> list[YawPose]:
        """Poses of the objects; the upper corner of the workspace for each removed one."""
        corner = self.settings.workspace.upper_corner
        poses = [(body.position, body.yaw_rad) for body in self.objects]
        return poses + [(corner, 0.0)] * (self.settings.num_objects - len(poses))

    def get_state(self) -> tuple[tuple[int, ...], int]:
        """Return the indices of the active objects and the number of attempts."""
        return self.pool.get_state(), self.attempts

    def set_state(self, state: tuple[tuple[int, ...], int]) -> None:
        """Restore the active objects and the number of attempts."""
        active, self.attempts = state
        self.pool.set_state(active)
