"""Random deviations from grasps that are likely to fail."""

from __future__ import annotations

import math

import numpy as np

from ba_torchrl.actions import PickPlaceCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Pose
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.pick_place_commands import pick_command

OFFSET_SHARE = 1.0
"""Largest deviation of a grasp along each axis, as a multiple of the object's half extent."""


def scene_generator(world: World) -> np.random.Generator:
    """Return a random generator that is seeded with the exact poses of the bodies.

    A failed grasp moves the objects that it touches at least in the last bits, so the next draw
    differs, while an expert with this generator remains a function of the scene.

    Args:
        world: the world of the bodies.
    """
    poses = [(*body.position, *body.pose.orientation) for body in world.bodies]
    return np.random.default_rng(np.array(poses).view(np.uint64).ravel())


def perturbed_pick(world: World, body: Body, grasp: Pose, *, can_turn: bool) -> PickPlaceCommand:
    """Return a pick with a random deviation from a grasp, the same for the same scene.

    It may succeed where the grasp fails, or push the body to where the grasp succeeds. Small
    deviations are more likely than large ones.

    Args:
        world: the world of the body.
        body: the body.
        grasp: pose of the tool.
        can_turn: whether the yaw of the tool may deviate.
    """
    rng = scene_generator(world)
    low, high = np.array(body.shape.bounds_m)
    share = rng.uniform()
    half = OFFSET_SHARE * share * (high - low) / 2
    dx, dy, _ = body.pose.rotate(rng.uniform(-half, half)[None])[0].tolist()
    x, y, z = grasp.position
    turn = share * float(rng.uniform(-math.pi / 2, math.pi / 2)) if can_turn else 0.0
    return pick_command(grasp.moved_to((x + dx, y + dy, z), turn))
