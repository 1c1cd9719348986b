"""Colour images of a scene for people: the camera pose, and the arm of open-loop tasks.

These images have no effect on the simulation: a pose of the arm for an image is set in a second
world. In it, too, the arm moves between the poses of an open-loop step in videos.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pybullet

from ba_torchrl.envs.scene import Scene
from ba_torchrl.sim.bodies import Body, world_vertices
from ba_torchrl.sim.control.pick_place import approach_point
from ba_torchrl.sim.geometry import (
    Matrix,
    Pose,
    Vector,
    bullet_compose,
    downward,
    quaternion_matrix,
)
from ba_torchrl.sim.vision.rgb import FOV_DEG, Viewpoint, fit_viewpoint
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.terrain.flat import Terrain


class Direction(NamedTuple):
    """Direction in which a camera looks."""

    yaw_deg: float
    pitch_deg: float


WORKSPACE_VIEW = Direction(78.0, -36.0)
"""Of images that are filled by the workspace."""
ARM_VIEW = Direction(40.0, -28.0)
"""Of images that show the whole arm, from its side."""
MARGIN = 0.015
"""Empty border of an image, as a fraction of its width and height."""


class RelativePoint(NamedTuple):
    """A point in relation to a workspace and its terrain."""

    dx: float
    dy: float
    """x and y from the centre, as fractions of the width."""
    height_m: float
    """Height above the surface."""

    def above(self, terrain: Terrain) -> Vector:
        """Return the point above a terrain, metres."""
        (x, y), width = terrain.workspace.center, terrain.workspace.width
        xy = (x + self.dx * width, y + self.dy * width)
        return *xy, terrain.height_m(xy) + self.height_m


DISPLAY_POINT = RelativePoint(-0.3, 0.3, 0.15)
"""Position of the tool in images of open-loop tasks between actions."""
DISPLAY_YAW_RAD = 0.7
ARM_HEIGHTS_M = (0.0, 0.15, 0.25)
"""Heights of the tool at which an image shows the whole arm."""
LINK_RADIUS_M = 0.09
"""Half the edge of the cube around the origin of each link that is in such an image."""
FRAME_DISTANCE_M = 0.09
"""Distance between positions of the tool in successive frames of an interpolated motion."""
FRAME_ROTATION_RAD = 0.6
"""Largest displacement of a joint between these frames."""


def scene_viewpoint(
    world: World,
    terrain: Terrain,
    arm_m: Sequence[float] | np.ndarray,
    aspect: float,
    direction: Direction = WORKSPACE_VIEW,
) -> Viewpoint:
    """Return the camera pose that shows the workspace, the static bodies in it and the arm.

    It depends on nothing that moves, so that all images of an episode have the same.

    Args:
        terrain: of the task; its bodies are shown in the workspace only.
        arm_m: a point of the arm or several, [3] or [N, 3], which the image shows as well.
        aspect: width of the image divided by its height.
    """
    workspace = terrain.workspace
    low, high = np.transpose([workspace.x, workspace.y])
    corners = list(itertools.product(workspace.x, workspace.y, [0.0]))
    points = [np.vstack([arm_m, corners])]
    for body in world.bodies:
        if body.is_static and not body.is_hidden:
            vertices = world_vertices(body)
            xy = vertices[:, :2]
            if body.id in terrain.support_ids:
                points.append(np.hstack([xy.clip(low, high), vertices[:, 2:]]))
            elif (xy.min(0) < high).all() and (xy.max(0) > low).all():
                points.append(vertices)
    return fit_viewpoint(np.concatenate(points), *direction, FOV_DEG, aspect, MARGIN)


class ArmDisplay:
    """A second world with the bodies of a scene, for images with the arm in another pose."""

    def __init__(self, build: Callable[[float], Scene]) -> None:
        self._build = build
        self._scene: Scene | None = None
        self._scale: float | None = None
        self._held: tuple[Body, Pose] | None = None
        self._path: list[list[float]] = []
        self._extent_m: np.ndarray | None = None

    def posed(self, scene: Scene, scale: float, position: Vector, rotation: Matrix) -> World:
        """Return a world that equals a scene, with the arm and the held body at a pose.

        The arm keeps its pose if the other one is out of reach.
        """
        if scale != self._scale:
            self.close()
            self._scene, self._scale = self._build(scale), scale
        world, robot = self._scene.world, self._scene.robot
        copy_poses(scene.world, world)
        joints = robot.inverse_kinematics(position, rotation, scene.robot.joints)
        held, self._held = scene.controller.held, None
        if held is not None:
            self._held = world.bodies[scene.world.bodies.index(held)], scene.controller.grasp
        if joints is not None:
            self._move(joints)
        return world

    def approach(self, joints: Sequence[float], *, top_down: bool) -> Iterator[World]:
        """Yield the world while the arm moves from the pose of `posed` to a grasp or a release.

        The joints are interpolated to the start of the approach, then to its end. Both ends of the
        motion are left out. A held body moves with the hand.

        Args:
            joints: of the arm at the grasp or the release.
            top_down: whether the arm approaches vertically even with a tilted tool.
        """
        robot, limits = self._scene.robot, self._scene.controller.limits
        ends = [robot.measured_joints(), list(joints)]
        start = robot.tool_frame().position
        self._move(joints)
        position, orientation = robot.tool_frame()
        rotation = quaternion_matrix(orientation)
        before = approach_point(position, rotation, limits.approach_distance_m, top_down=top_down)
        between = robot.inverse_kinematics(before, rotation, joints)
        points = [start, position]
        if between is not None:
            ends.insert(1, between)
            points.insert(1, before)
        self._path = ends[:1]
        for (a, b), (p, q) in zip(
            itertools.pairwise(ends), itertools.pairwise(points), strict=True
        ):
            self._path += _interpolated(np.array(a), np.array(b), math.dist(p, q))
        del self._path[-1]
        for joints in self._path[1:]:
            self._move(joints)
            yield self._scene.world

    def extent_m(self) -> np.ndarray:
        """Return points [N, 3] that enclose the arm in all its poses above the workspace.

        They are the corners of cubes around its links, with the tool pointing down above the
        corners of the workspace at `ARM_HEIGHTS_M`.
        """
        if self._extent_m is None:
            robot, workspace = self._scene.robot, self._scene.task.settings.workspace
            joints, links = robot.measured_joints(), []
            for position in itertools.product(workspace.x, workspace.y, ARM_HEIGHTS_M):
                solution = robot.inverse_kinematics(position, downward(DISPLAY_YAW_RAD), joints)
                if solution is not None:
                    robot.teleport(solution)
                    links += robot.link_positions()
            self._move(joints)
            cube = np.array([*itertools.product((-LINK_RADIUS_M, LINK_RADIUS_M), repeat=3)])
            points = (np.array(links)[:, None] + cube).reshape(-1, 3)
            self._extent_m = points.clip([-np.inf, -np.inf, 0.0], np.inf)  # above the floor
        return self._extent_m

    def retreat(self) -> Iterator[World]:
        """Yield the world while the arm moves back on the path of the last `approach`, if any.

        At the end, the arm is in the pose of `posed`.
        """
        path, self._path = self._path, []
        for joints in reversed(path[1:]):
            self._move(joints)
            yield self._scene.world
        if path:
            self._move(path[0])

    def _move(self, joints: Sequence[float]) -> None:
        """Set the arm joints, and the pose of the held body in the tool frame."""
        robot = self._scene.robot
        robot.teleport(joints)
        if self._held is not None:
            body, grasp = self._held
            body.set_pose(*bullet_compose(robot.tool_frame(), grasp))

    def close(self) -> None:
        """Close the world; the next call of `posed` builds another."""
        if self._scene is not None:
            self._scene.world.close()
        self._scene = self._scale = self._extent_m = None


def _interpolated(start: np.ndarray, end: np.ndarray, distance_m: float) -> list[list[float]]:
    """Return joints from ``start``, which is left out, to ``end`` for a distance of the tool."""
    most = max(distance_m / FRAME_DISTANCE_M, np.abs(end - start).max() / FRAME_ROTATION_RAD)
    return np.linspace(start, end, max(math.ceil(most), 1) + 1)[1:].tolist()


def copy_poses(source: World, target: World) -> None:
    """Copy the poses and joint positions of all bodies, robot included, to a world of the same.

    Args:
        target: has the same bodies, loaded in the same order.
    """
    here, there = {"physicsClientId": source.client}, {"physicsClientId": target.client}
    for index in range(pybullet.getNumBodies(**here)):
        body = pybullet.getBodyUniqueId(index, **here)
        pose = pybullet.getBasePositionAndOrientation(body, **here)
        pybullet.resetBasePositionAndOrientation(body, *pose, **there)
        for joint in range(pybullet.getNumJoints(body, **here)):
            position = pybullet.getJointState(body, joint, **here)[0]
            pybullet.resetJointState(body, joint, position, **there)
    for body, copy in zip(source.bodies, target.bodies, strict=True):
        copy.is_hidden = body.is_hidden
