"""Experts' actions as labels: how far an action is from a label, and labels that jump.

A label jumps if it changes with the last bits of the state. No policy can learn it there, since the
two states look the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
from tensordict import TensorDictBase

from ba_torchrl.core import keys
from ba_torchrl.core.actions import CloseLoopActions, OpenLoopActions
from ba_torchrl.envs.base import BulletArmEnv
from ba_torchrl.envs.policies import expert_policy
from ba_torchrl.envs.scene import Scene
from ba_torchrl.sim.geometry import euler_matrix, quaternion_product, tool_rotation
from ba_torchrl.testing.episodes import MAX_EPISODE_STEPS, make_small

LAST_BITS = 1e-6
"""Largest change of a coordinate, metres, and of an angle, radians, that no image shows."""
ASKS = 3
"""Changes of a state after which the expert is asked for its label again."""
JUMP_MM = 5.0
"""Least distance between two labels of a jump; a pixel of an image of 128 px is 3 to 4 mm wide."""
JUMP_DEG = 10.0
"""Least rotation between two labels of a jump."""
OPENING = 0.5
"""Difference between two openings of the gripper, 0 to 1, at which one opens and one closes it."""


class Offset(NamedTuple):
    """How far an action is from another one."""

    x_mm: float
    """Difference of the targets (open loop) or of the displacements (close loop), also y and z."""
    y_mm: float
    z_mm: float
    """0 if the action has no z."""
    rotation_deg: float
    """Angle between the tool's orientations (open loop) or the changes of its yaw (close loop)."""
    is_other_primitive: bool
    """Whether one action picks and the other places, or their openings of the gripper differ by
    more than `OPENING`."""

    @property
    def distance_mm(self) -> float:
        """Length of the difference."""
        return math.hypot(self.x_mm, self.y_mm, self.z_mm)

    @property
    def is_jump(self) -> bool:
        """Whether two labels of states that look the same differ too much to be learned."""
        is_far = self.distance_mm > JUMP_MM or self.rotation_deg > JUMP_DEG
        return is_far or self.is_other_primitive


def offset_of(
    actions: OpenLoopActions | CloseLoopActions, action: np.ndarray, label: np.ndarray
) -> Offset:
    """Return how far an action is from a label, both [A].

    With ``half_rotation``, half a turn of the tool about its own axis makes no difference.
    """
    if isinstance(actions, CloseLoopActions):
        ours, theirs = actions.decode(action), actions.decode(label)
        moves = [1000 * (a - b) for a, b in zip(ours[1:4], theirs[1:4], strict=True)]
        turn = math.degrees(abs(ours.dyaw_rad - theirs.dyaw_rad))
        return Offset(*moves, turn, abs(ours.opening - theirs.opening) > OPENING)
    pose, other = actions.decode(action), actions.decode(label)
    moves = [1000 * ((a or 0.0) - (b or 0.0)) for a, b in zip(pose[1:4], other[1:4], strict=True)]
    here = np.array(tool_rotation(*pose.angles_rad))
    swapped = np.array(euler_matrix(math.pi, 0.0, 0.0)) if actions.half_rotation else np.eye(3)
    there = np.array(tool_rotation(*other.angles_rad))
    turn = min(_angle_deg(here.T @ there), _angle_deg(here.T @ there @ swapped))
    return Offset(*moves, turn, pose.primitive != other.primitive)


def nearest_offset(
    actions: OpenLoopActions | CloseLoopActions, action: np.ndarray, labels: Iterable[np.ndarray]
) -> Offset:
    """Return how far an action is from the nearest of several labels, a degree counted as 1 mm."""
    offsets = (offset_of(actions, action, label) for label in labels)
    return min(
        offsets, key=lambda o: (o.is_other_primitive, math.hypot(o.distance_mm, o.rotation_deg))
    )


def _angle_deg(rotation: np.ndarray) -> float:
    """Return the angle of a rotation matrix."""
    sine = np.linalg.norm(rotation - rotation.T) / math.sqrt(8)
    return math.degrees(math.atan2(sine, (np.trace(rotation) - 1) / 2))


def label_jumps(
    env: BulletArmEnv, state: TensorDictBase, rng: np.random.Generator, asks: int = ASKS
) -> bool:
    """Return whether the expert's action jumps in a state, which is restored at the end.

    The arm and all bodies that move freely are displaced by up to `LAST_BITS`, and the expert is
    asked again. A change to another of its equal moves is no jump.

    Args:
        env: in the state.
        state: what `BulletArmEnv.get_state` returned.
        rng: draws the displacements.
        asks: their largest number.
    """
    robot, labels = env.scene.robot, _labels(env)
    bodies = [body for body in env.scene.world.bodies if body.is_free and not body.is_hidden]
    poses, joints = [body.pose for body in bodies], robot.measured_joints()

    def moved_label() -> np.ndarray:
        robot.place_arm(joints + rng.uniform(-LAST_BITS, LAST_BITS, len(joints)))
        for body, (position, orientation) in zip(bodies, poses, strict=True):
            turn = (*rng.uniform(-LAST_BITS / 2, LAST_BITS / 2, 3).tolist(), 1.0)
            moved = position + rng.uniform(-LAST_BITS, LAST_BITS, 3)
            body.set_pose(tuple(moved.tolist()), quaternion_product(turn, orientation))
        return _labels(env)[0]

    try:
        return any(nearest_offset(env.actions, moved_label(), labels).is_jump for _ in range(asks))
    finally:
        env.reset(state, set_state=True)


def _labels(env: BulletArmEnv) -> list[np.ndarray]:
    """Return the expert's action in the present scene, and the moves that it holds for equal."""
    scene: Scene = env.scene
    with scene.world.fixed_poses():
        if scene.task.equal_moves:
            moves = scene.task.expert_moves()
        else:
            moves = [scene.task.expert_command()]
        return [env.actions.encode(move) for move in moves]


def label_jump_share(task: str, *, episodes: int, **config: Any) -> float:
    """Return the share of states in the expert's episodes whose label jumps."""
    rng, jumps = np.random.default_rng(0), []
    with closing(make_small(task, expert=True, **config)) as env:
        for _ in range(episodes):
            state = env.reset()
            while not state[keys.DONE] and state[keys.STEP_COUNT] < MAX_EPISODE_STEPS:
                jumps.append(label_jumps(env, env.get_state(), rng))
                state = env.step(expert_policy(state))[keys.NEXT]
    return float(np.mean(jumps))
