"""Contract check of an expert's progress: it sends no action twice into an unchanged scene."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
from tensordict import TensorDictBase

from ba_torchrl.core import keys
from ba_torchrl.envs.base import BulletArmEnv
from ba_torchrl.envs.policies import expert_policy
from ba_torchrl.envs.scene import Scene
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.geometry import Quaternion, yaw_quaternion
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.manipulation.clearance import passing_height_m
from ba_torchrl.tasks.manipulation.footprints import narrowest, outline
from ba_torchrl.testing.episodes import action_at, make_small, random_actions

MAX_STEPS = 60
"""Step limit of the disturbed episodes, which need more steps than others."""
MAX_REPETITIONS = 4
"""Number of times that a cycle of actions and scenes counts as endless."""
POSITION_M = 5e-4
"""Bodies and grippers are at the same position within this."""
ROTATION_RAD = 0.01
"""Bodies and grippers have the same orientation within this."""
OPENING = 5e-3
"""Openings of the gripper are the same within this."""
ACTION_SHARE = 1e-3
"""Actions are the same within this share of the range of each component."""
FINGER_GAP_M = 2e-3
"""Least gap between an object and a finger that descends beside it."""
HELD_STEPS = 3
"""Largest number of actions with closed fingers after the descent around an object."""
BORDER_M = 0.005
"""Least distance of a dropped object from the border of the workspace."""
DROP_M = 0.02
"""Largest height from which an object is dropped."""
LARGE_M = 0.3
"""Width of bodies, such as the ground, beside which no object is dropped."""
FLUSH_SHARE = 0.7
"""Share of the dropped objects that are flush with another body."""
TILTED_SHARE = 0.3
"""Share of the dropped objects with a random orientation in three dimensions."""
SETTLE_STEPS = 400
"""Largest number of physics steps until a dropped object is at rest."""


class SceneView(NamedTuple):
    """The parts of a scene that an action changes."""

    positions: np.ndarray
    """[N, 3] positions of the free bodies and the tool, metres."""
    orientations: np.ndarray
    """[N, 4] their quaternions."""
    opening: float
    """Opening of the gripper, 0 to 1."""

    @classmethod
    def of(cls, scene: Scene) -> SceneView:
        """Return the view of a scene."""
        bodies = [body for body in scene.world.bodies if body.is_free and not body.is_hidden]
        poses = [*(body.pose for body in bodies), scene.robot.tool_frame()]
        positions, orientations = (np.array(values) for values in zip(*poses, strict=True))
        return cls(positions, orientations, scene.robot.opening())

    def is_same(self, other: SceneView) -> bool:
        """Whether two views differ by less than the tolerances."""
        if self.positions.shape != other.positions.shape:
            return False
        cosines = np.abs((self.orientations * other.orientations).sum(axis=1))
        return bool(
            np.abs(self.positions - other.positions).max() < POSITION_M
            and cosines.min() > math.cos(ROTATION_RAD / 2)
            and abs(self.opening - other.opening) < OPENING
        )


class Disturbed(NamedTuple):
    """The expert's steps from a disturbed scene."""

    views: list[SceneView]
    """The scene before each action."""
    actions: list[np.ndarray]
    """The actions, as shares of the range of each component."""
    is_solved: bool
    is_truncated: bool
    most_refused: int
    """Largest number of successive actions that were out of reach."""

    def repetitions(self, step: int) -> list[int]:
        """Return the earlier steps with the action and the scene of a step."""
        view, action = self.views[step], self.actions[step]
        return [
            i
            for i in range(step)
            if np.abs(self.actions[i] - action).max() < ACTION_SHARE and self.views[i].is_same(view)
        ]


Disturb = Callable[[BulletArmEnv, TensorDictBase, np.random.Generator], TensorDictBase]


def check_progress(
    task: str, *, episodes: int, max_unsolved_rate: float = 0.0, **config: Any
) -> None:
    """Check that the expert ends episodes from disturbed scenes and repeats no futile action.

    It may not send an action twice in succession into an unchanged scene, return to a scene and
    action `MAX_REPETITIONS` times, or send that many actions out of reach in succession. The scenes
    are disturbed by random actions, by fingers that close around an object (close loop), and by an
    object that is dropped, often flush with another body (open loop). Tasks of one step are exempt.
    At most ``max_unsolved_rate`` of the episodes may reach the step limit.
    """
    if TASKS[task].terminates_at_limit:
        return
    with closing(make_small(task, expert=True, max_steps=MAX_STEPS, **config)) as env:
        for disturb in DISTURBANCES[TASKS[task].control]:
            unsolved = []
            for seed in range(episodes):
                played = play_disturbed(env, seed, disturb)
                if played is None:
                    continue
                _check_repetitions(played, f"{task}: after {disturb.__name__} with seed {seed}")
                if played.is_truncated and not played.is_solved:
                    unsolved.append(seed)
            assert len(unsolved) <= max_unsolved_rate * episodes, (
                f"{task}: after {disturb.__name__} the expert does not end the episodes of seeds "
                f"{unsolved} in {MAX_STEPS} steps"
            )


def play_disturbed(env: BulletArmEnv, seed: int, disturb: Disturb) -> Disturbed | None:
    """Return the expert's steps from a disturbed scene; None if the disturbance ends the episode.

    The seed is that of the episode and of the disturbance.
    """
    state = disturb(env, env.reset(seed=seed), np.random.default_rng(seed))
    if state[keys.DONE]:
        return None
    low, high = env.action_spec.space.low, env.action_spec.space.high
    views, actions = [], []
    refused = most_refused = 0
    while not state[keys.DONE]:
        views.append(SceneView.of(env.scene))
        state = expert_policy(state)
        actions.append(((state[keys.ACTION] - low) / (high - low)).numpy())
        state = env.step(state)[keys.NEXT]
        refused = refused + 1 if env.is_out_of_reach else 0
        most_refused = max(most_refused, refused)
    is_solved, is_truncated = bool(state[keys.SUCCESS]), bool(state[keys.TRUNCATED])
    return Disturbed(views, actions, is_solved, is_truncated, most_refused)


def _check_repetitions(played: Disturbed, where: str) -> None:
    """Check that no futile action is repeated."""
    assert played.most_refused < MAX_REPETITIONS, (
        f"{where} the expert sends {played.most_refused} actions out of reach in succession"
    )
    for step in range(1, len(played.actions)):
        earlier = played.repetitions(step)
        assert step - 1 not in earlier, (
            f"{where} the expert sends the action of step {step - 1} again, though it changed "
            "nothing"
        )
        assert len(earlier) < MAX_REPETITIONS - 1, (
            f"{where} the expert sends the same action into the same scene at steps "
            f"{[*earlier, step]}"
        )


# -- disturbances ----------------------------------------------------------------------------


def close_around_object(
    env: BulletArmEnv, state: TensorDictBase, rng: np.random.Generator
) -> TensorDictBase:
    """Close the fingers around a random object, then move at random with closed fingers."""
    scene, gripper = env.scene, env.scene.robot.gripper
    sides = [(narrowest(body)[0], vertical_extent(body)) for body in scene.task.objects]
    fitting = [pair for pair in sides if pair[0].half_x < gripper.half_gap_m - FINGER_GAP_M]
    if not fitting:
        return random_actions(env, state, rng)
    side, (low, high) = fitting[rng.integers(len(fitting))]
    yaw = (side.yaw_rad + math.pi / 2) % math.pi - math.pi / 2
    x, y, z = env.workspace.clip((side.x, side.y, float(rng.uniform((low + high) / 2, high))))
    above_z = min(high + passing_height_m(gripper), env.workspace.z[1])
    scene.controller.reset(((x, y, above_z), yaw))
    scene.controller.move_to((x, y, z), yaw)
    for i in range(1 + int(rng.integers(HELD_STEPS))):
        shares = rng.uniform(0, 1, len(env.actions.sequence)) if i else np.full(7, 0.5)
        shares[env.actions.sequence.index("p")] = 0.0  # closed
        action = action_at(env, shares.astype(np.float32).tolist())
        state = env.step(state.set(keys.ACTION, action))[keys.NEXT]
        if state[keys.DONE]:
            break
    return state


def drop_object(
    env: BulletArmEnv, state: TensorDictBase, rng: np.random.Generator
) -> TensorDictBase:
    """Drop a random object at a random pose, often flush with another body."""
    scene = env.scene
    objects = list(scene.task.objects)
    if not objects:
        return random_actions(env, state, rng)
    body = objects[rng.integers(len(objects))]
    xy, yaw = _random_place(env, body, rng)
    orientation: Quaternion = yaw_quaternion(yaw)
    if rng.random() < TILTED_SHARE:
        quaternion = rng.normal(size=4)
        orientation = tuple((quaternion / np.linalg.norm(quaternion)).tolist())
    body.set_pose((*xy, 0.0), orientation)
    z = -scene.task.terrain.gap_below_m(body)
    body.set_pose((*xy, z + float(rng.uniform(0.1, 1)) * DROP_M), orientation)
    scene.world.settle(max_steps=SETTLE_STEPS)
    shares = np.full(7, 0.5)
    shares[env.actions.sequence.index("p")] = 1.0  # a place without an object has no effect
    action = action_at(env, shares.astype(np.float32).tolist())
    return env.step(state.set(keys.ACTION, action))[keys.NEXT]


def _random_place(
    env: BulletArmEnv, body: Body, rng: np.random.Generator
) -> tuple[tuple[float, float], float]:
    """Return a random position and yaw of a body, often flush with a side of another body."""
    others = [
        around
        for other in env.scene.world.bodies
        if other is not body
        and not other.is_hidden
        and max((around := outline(other)).half_x, around.half_y) < LARGE_M / 2
    ]
    yaw = float(rng.uniform(0, 2 * math.pi))
    ranges = env.workspace.x, env.workspace.y
    xy = [rng.uniform(low + BORDER_M, high - BORDER_M) for low, high in ranges]
    if others and rng.random() < FLUSH_SHARE:
        around = others[rng.integers(len(others))]
        yaw = around.yaw_rad + math.pi / 2 * int(rng.integers(4))
        body.place((0.0, 0.0, 0.0), yaw)
        own = outline(body, around.yaw_rad)
        side, sign = int(rng.integers(2)), 1 if rng.random() < 0.5 else -1
        halves, own_halves = (around.half_x, around.half_y), (own.half_x, own.half_y)
        local = [0.0, 0.0]
        local[side] = sign * (halves[side] + own_halves[side])
        local[1 - side] = float(rng.uniform(-1, 1)) * halves[1 - side]
        # the centre of the outline is placed there, not the origin of the body
        xy = np.subtract(around.frame.to_world(*local), (own.x, own.y))
    x, y, _ = env.workspace.clip((float(xy[0]), float(xy[1]), 0.0))
    return (x, y), yaw


DISTURBANCES: dict[str, tuple[Disturb, ...]] = {
    "close_loop": (random_actions, close_around_object),
    "open_loop": (random_actions, drop_object),
}
"""The disturbances, by control."""
