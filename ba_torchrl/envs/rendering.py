"""Colour images of a scene for people: the camera pose, and the arm of open-loop tasks.

These images have no effect on the simulation: a pose of the arm for an image is set in a second
world.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pybullet

from ba_torchrl.envs.scene import Scene
from ba_torchrl.sim.bodies import world_vertices
from ba_torchrl.sim.geometry import Matrix, Vector, bullet_compose
from ba_torchrl.sim.vision.rgb import FOV_DEG, Viewpoint, fit_viewpoint
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.terrain.flat import Terrain

YAW_DEG = 78.0
PITCH_DEG = -36.0
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


def scene_viewpoint(world: World, terrain: Terrain, hand_m: Vector, aspect: float) -> Viewpoint:
    """Return the camera pose that shows the workspace, the static bodies in it and the hand.

    It depends on nothing that moves, so that all images of an episode have the same.

    Args:
        world: the scene.
        terrain: of the task; its bodies are shown in the workspace only.
        hand_m: point of the hand, which the image shows as well.
        aspect: width of the image divided by its height.
    """
    workspace = terrain.workspace
    low, high = np.transpose([workspace.x, workspace.y])
    points = [np.array([hand_m, *itertools.product(workspace.x, workspace.y, [0.0])])]
    for body in world.bodies:
        if body.is_static and not body.is_hidden:
            vertices = world_vertices(body)
            xy = vertices[:, :2]
            if body.id in terrain.support_ids:
                points.append(np.hstack([xy.clip(low, high), vertices[:, 2:]]))
            elif (xy.min(0) < high).all() and (xy.max(0) > low).all():
                points.append(vertices)
    return fit_viewpoint(np.concatenate(points), YAW_DEG, PITCH_DEG, FOV_DEG, aspect, MARGIN)


class ArmDisplay:
    """A second world with the bodies of a scene, for images with the arm in another pose.

    Args:
        build: builds the scene for objects of a scale.
    """

    def __init__(self, build: Callable[[float], Scene]) -> None:
        self._build = build
        self._scene: Scene | None = None
        self._scale: float | None = None

    def posed(self, scene: Scene, scale: float, position: Vector, rotation: Matrix) -> World:
        """Return a world that equals a scene, with the arm and the held body at a pose.

        The arm keeps its pose if the other one is out of reach.

        Args:
            scene: an open-loop scene.
            scale: of its objects.
            position: of the tool, metres.
            rotation: of the tool.
        """
        if scale != self._scale:
            self.close()
            self._scene, self._scale = self._build(scale), scale
        world, robot = self._scene.world, self._scene.robot
        copy_poses(scene.world, world)
        joints = robot.inverse_kinematics(position, rotation, scene.robot.joints)
        held = scene.controller.held
        if joints is not None:
            robot.teleport(joints)
            if held is not None:
                body = world.bodies[scene.world.bodies.index(held)]
                body.set_pose(*bullet_compose(robot.tool_frame(), scene.controller.grasp))
        return world

    def close(self) -> None:
        """Close the world; the next call of `posed` builds another."""
        if self._scene is not None:
            self._scene.world.close()
        self._scene = self._scale = None


def copy_poses(source: World, target: World) -> None:
    """Copy the poses and joint positions of all bodies, robot included, to a world of the same.

    Args:
        source: is not changed.
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
