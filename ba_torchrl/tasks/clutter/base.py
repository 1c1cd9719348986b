"""Clutter: a heap of objects in a tray that lasts from one episode to the next."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ba_torchrl.config import TaskParameters
from ba_torchrl.sim.assets.base import load_object_set
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Quaternion, YawPose, downward
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.vision.depth import HeightCamera
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.base import Task, TaskSettings
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.clutter.grasp_planner import GraspPlanner
from ba_torchrl.tasks.clutter.tray import Tray

FAILURES_ALLOWED = 3
"""Episodes in a row that take nothing, until new objects fall."""

DROP_Z_M = 0.2
DROP_INTERVAL_S = 0.15
"""Time between objects: each falls 11 cm, out of the next one's way."""
WALL_M = 0.03
"""Objects start this far from the edge of the tray's floor at least."""
SETTLE_S = 4.0
LOW_DROP_M = 5e-3
APART_M = 5e-3
LAYOUTS = 20
TRIES = 50
DROP_ATTEMPTS = 3
"""Heaps tried until one comes to rest inside its area; round objects may roll for long."""

RETREAT_Z_M = (0.55, 0.5, 0.45, 0.4, 0.35)
"""Heights to which the arm retreats while objects fall: the first that is in its reach."""


class Clutter:
    """A tray, every shape of an object set, and the heap that some of them form.

    A heap lasts until all of it was taken out or too many episodes in a row took nothing.

    Args:
        world: not sealed yet.
        robot: keeps away while objects fall.
        tray: where they fall.
        settings: of the task; their `parameters` name the object set.
    """

    def __init__(self, world: World, robot: Robot, tray: Tray, settings: TaskSettings) -> None:
        self.world = world
        self.robot = robot
        self.settings = settings
        self.failures = 0
        """Episodes in a row that took nothing."""
        self.tray = tray
        parameters = settings.parameters
        shapes = load_object_set(parameters.object_set, parameters.asset_root)
        copies = -(-settings.num_objects // len(shapes))
        numbers = [f" {copy + 1}" if copies > 1 else "" for copy in range(copies)]
        self.pool = BodyPool(
            world,
            [shape for _ in numbers for shape in shapes],
            [f"{name}{number}" for number in numbers for name in shapes.names],
        )

    def should_continue(self, grasped_object: Body | None) -> bool:
        """Whether the next episode goes on with the heap.

        Args:
            taken: what the last one took out, if anything.
        """
        if grasped_object is not None:
            return len(self.pool.present) > 1
        return bool(self.pool.present) and self.failures + 1 < FAILURES_ALLOWED

    def advance(self, grasped_object: Body | None) -> None:
        """Put aside what an episode took out, and count those that took nothing."""
        if grasped_object is None:
            self.failures += 1
        else:
            self.pool.deactivate(grasped_object)
            self.failures = 0

    def drop(self, rng: np.random.Generator) -> None:
        """Let new objects fall one by one and come to rest.

        Their orientation is any; or, where the settings ask for fixed ones, upright with yaw 0.
        These come down apart and from close above, so that they stay so, and last those for which
        there is no room any more.

        Args:
            rng: draws objects and poses.
        """
        self.failures = 0
        settings, world, pool = self.settings, self.world, self.pool
        center = np.array(settings.workspace.center)
        half_m = self.tray.half_m
        count = settings.num_objects
        joints = self.robot.joints
        self._retreat()
        pause = round(DROP_INTERVAL_S / world.physics.time_step_s)
        for _ in range(DROP_ATTEMPTS):
            pool.clear()
            chosen = rng.choice(len(pool.bodies), size=count, replace=False)
            bodies = [pool.bodies[i] for i in chosen]
            apart = {} if settings.random_orientation else _apart(rng, bodies, half_m)
            for i, (x, y) in apart.items():
                place = (x + center[0], y + center[1])
                z = self.tray.height_m(place) + LOW_DROP_M - bodies[i].shape.bounds_m[0][2]
                pool.activate(bodies[i])
                bodies[i].place((*place, z))
            for i in sorted(set(range(count)) - set(apart)):
                x, y = center + rng.uniform(WALL_M - half_m, half_m - WALL_M, 2)
                turn = _random_turn(rng) if settings.random_orientation else (0.0, 0.0, 0.0, 1.0)
                pool.activate(bodies[i])
                bodies[i].set_pose((x, y, DROP_Z_M), turn)
                world.step(pause)
            if world.settle(round(SETTLE_S / world.physics.time_step_s)):
                break
        self.robot.teleport(joints)

    def _retreat(self) -> None:
        """Put the arm high above the heap, as high as it reaches."""
        robot, center_xy = self.robot, self.settings.workspace.center
        ways = (robot.inverse_kinematics((*center_xy, z), downward(0.0)) for z in RETREAT_Z_M)
        joints = next((found for found in ways if found is not None), robot.joints)
        robot.teleport(joints)


class ClutterTask(Task):
    """A task whose episodes each take something out of a heap, and go on with what is left.

    New objects fall in once the tray is empty, an object left the workspace, or three episodes in a
    row came to nothing, such as those that are reset before they end.
    """

    needs_fresh_world = True
    scale_limits = (1.0, 1.0)

    class Parameters(TaskParameters):
        """The objects of the heap."""

        object_set: str = "random"
        """The set that the objects are drawn from; see `ba_torchrl.sim.assets`."""
        asset_root: str | None = None
        """Folder of a set of objects that does not ship with the package."""

    @abstractmethod
    def grasped_object(self) -> Body | None:
        """Return what this episode took out, if anything."""

    def load_scene(self) -> None:
        """Load every shape of the object set."""
        self.clutter = Clutter(self.world, self.robot, self.terrain, self.settings)

    def make_terrain(self) -> Tray:
        """Load the tray."""
        return Tray(self.world, self.settings.workspace)

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Let new objects fall into the tray."""
        self.clutter.drop(rng)

    @property
    def continues(self) -> bool:
        """Whether something is left that is worth another try."""
        return self.clutter.should_continue(self.grasped_object())

    def resume(self) -> None:
        """Put aside what was taken."""
        self.clutter.advance(self.grasped_object())

    @cached_property
    def planner(self) -> GraspPlanner:
        """What finds grasps; made when an expert is first asked."""
        camera = HeightCamera(self.world.bodies)
        bodies = self.clutter.pool.bodies
        return GraspPlanner(bodies, camera, self.settings.workspace, self.robot.gripper)

    @property
    def objects(self) -> Sequence[Body]:
        """What is in the tray, and what was taken last."""
        return self.clutter.pool.present

    @property
    def landmarks(self) -> list[YawPose]:
        """Poses of the objects; for those that are gone, the workspace's upper corner."""
        workspace = self.settings.workspace
        corner = (workspace.x[1], workspace.y[1], workspace.z[1])
        poses = [(body.position, body.yaw_rad) for body in self.objects]
        return poses + [(corner, 0.0)] * (self.settings.num_objects - len(poses))

    def get_state(self) -> tuple[tuple[int, ...], int]:
        """Return which objects are in use, and the failures in a row."""
        return self.clutter.pool.get_state(), self.clutter.failures

    def set_state(self, state: tuple[tuple[int, ...], int]) -> None:
        """Take up what `get_state` returned."""
        present, self.clutter.failures = state
        self.clutter.pool.set_state(present)


def _apart(
    rng: np.random.Generator, bodies: Sequence[Body], half_m: float
) -> dict[int, tuple[float, float]]:
    """Return random points of a square about zero at which upright bodies do not touch, by index.

    Where there is no room for all of them, some are missing.

    Args:
        rng: draws the points.
        bodies: to be placed; large ones come first.
        half_m: half the width of the square, which they do not leave.
    """
    bounds = np.array([np.array(body.shape.bounds_m)[:, :2] for body in bodies])
    order = np.argsort(-np.prod(bounds[:, 1] - bounds[:, 0], axis=1))
    best: dict[int, tuple[float, float]] = {}
    for _ in range(LAYOUTS):
        points: dict[int, tuple[float, float]] = {}
        taken = np.empty((0, 2, 2))
        for i in order.tolist():
            low, high = bounds[i]
            tries = rng.uniform(-half_m - low, half_m - high, (TRIES, 1, 2))
            gaps = np.maximum(low + tries - taken[:, 1], taken[:, 0] - high - tries)
            free = np.flatnonzero((gaps.max(axis=2) > APART_M).all(axis=1))
            if len(free):
                point = tries[free[0], 0]
                points[i] = tuple(point.tolist())
                taken = np.concatenate([taken, [bounds[i] + point]])
        if len(points) > len(best):
            best = points
        if len(best) == len(bodies):
            break
    return best


def _random_turn(rng: np.random.Generator) -> Quaternion:
    """Return an orientation uniform over all there are."""
    quaternion = rng.normal(size=4)
    return tuple((quaternion / np.linalg.norm(quaternion)).tolist())
