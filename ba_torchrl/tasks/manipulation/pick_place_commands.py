"""Pick and place commands from poses in SE(3)."""

from __future__ import annotations

import math

import numpy as np

from ba_torchrl.core.actions import PICK, PLACE, PickPlaceCommand
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Pose, carrying_pose, tool_angles
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.workspace import ActionLimits, Workspace

LEVEL_RAD = 0.02
"""A tilt below this counts as zero; the home pose is tilted by up to 1e-3."""
ROUNDING_RAD = 1e-9
"""A yaw below this counts as zero. A tiny negative yaw would wrap to half a turn."""
NO_OP_Z_M = 0.1
"""Height of the tool of a no-op."""


def pick_command(tool: Pose) -> PickPlaceCommand:
    """Return the pick at a pose of the tool."""
    return _command(PICK, tool)


def place_command(tool: Pose, held: Pose, target: Pose) -> PickPlaceCommand:
    """Return the place that brings the held body to a pose.

    Args:
        target: pose of the held body at its release.
    """
    return _command(PLACE, carrying_pose(tool, held, target))


def swaps_fingers(tool: Pose) -> bool:
    """Whether an action with yaws in [0, pi] turns the tool by half a turn about its own axis.

    Such an action brings the fingers to the pose, but reverses a held body in it: the error of the
    place is twice the body's tilt and distance from the centre of the tool.
    """
    rz, _, _ = tool_angles(tool.orientation)
    return abs(rz) >= ROUNDING_RAD and rz % (2 * math.pi) > math.pi


def no_op(workspace: Workspace, is_holding: bool) -> PickPlaceCommand:
    """Return the command of an expert that has nothing left to do.

    Args:
        workspace: the pick or place is in its corner, above the ground.
        is_holding: whether a body is held; it is placed there. A pick there grasps nothing.
    """
    primitive = PLACE if is_holding else PICK
    return PickPlaceCommand(primitive, workspace.x[0], workspace.y[0], NO_OP_Z_M)


def _command(primitive: int, tool: Pose) -> PickPlaceCommand:
    """Return the command of a primitive at a pose of the tool."""
    rz, ry, rx = tool_angles(tool.orientation)
    rz = 0.0 if abs(rz) < ROUNDING_RAD else rz
    ry, rx = (0.0 if abs(angle) < LEVEL_RAD else angle for angle in (ry, rx))
    return PickPlaceCommand(primitive, *tool.position, rz, ry, rx)


def scene_generator(world: World) -> np.random.Generator:
    """Return a random generator that is seeded with the exact poses of the bodies.

    A failed grasp moves the objects that it touches at least in the last bits, so the next draw
    differs, while an expert with this generator remains a function of the scene.
    """
    poses = [(*body.position, *body.pose.orientation) for body in world.bodies]
    return np.random.default_rng(np.array(poses).view(np.uint64).ravel())


def perturbed_pick(world: World, body: Body, grasp: Pose, limits: ActionLimits) -> PickPlaceCommand:
    """Return a pick with a random deviation from a grasp, the same for the same scene.

    It may succeed where the grasp fails, or push the body to where the grasp succeeds. Along each
    axis it is at most half the body's extent; small deviations are more likely than large ones. The
    yaw deviates if the gripper can turn.
    """
    rng = scene_generator(world)
    low, high = np.array(body.shape.bounds_m)
    share = rng.uniform()
    half = share * (high - low) / 2
    dx, dy, _ = body.pose.rotate(rng.uniform(-half, half)[None])[0].tolist()
    x, y, z = grasp.position
    turn = share * float(rng.uniform(-math.pi / 2, math.pi / 2)) if limits.turn_rad else 0.0
    return pick_command(grasp.moved_to((x + dx, y + dy, z), turn))
