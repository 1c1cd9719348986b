"""Time reversal: episodes that take a structure apart become demonstrations that build it.

`DeconstructionEnv` takes structures apart and observes the action that reverses the last one.
`reverse_episode` works on recorded episodes, without a simulator. `replay_scores` measures whether
the reversed actions build the structure.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Unbounded

from ba_torchrl.core import keys
from ba_torchrl.core.actions import PICK
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.open_loop import OpenLoopEnv
from ba_torchrl.envs.scene import Scene
from ba_torchrl.envs.settings import ResolvedEnv, resolve_env
from ba_torchrl.tasks.structures.deconstruction import Deconstruction, UndoRecorder
from ba_torchrl.tasks.structures.open_loop import check_has_structure

_ENDS = (
    keys.REWARD,
    keys.DONE,
    keys.TERMINATED,
    keys.TRUNCATED,
    keys.SUCCESS,
    keys.FAULT,
    keys.STEP_COUNT,
)
UNDO_ACTION = "undo_action"
"""Key, like ``action``: the inverse of the last action."""
UNDO_IN_HAND = "undo_in_hand"
"""Key, like ``in_hand``: the in-hand image after the inverse action, if that is a pick."""
CAN_UNDO = "can_undo"
"""Key, [1] bool: the last action has an inverse, since it moved exactly one object."""
_EXTRA = (UNDO_ACTION, UNDO_IN_HAND, CAN_UNDO, *keys.OF_EXPERT)


class DeconstructionEnv(OpenLoopEnv):
    """An open-loop environment whose episodes start with the structure and take it apart.

    Every observation contains the action that reverses the last one.
    """

    def __init__(self, resolved: ResolvedEnv) -> None:
        check_has_structure(resolved.task_id)
        if resolved.config.reward != "sparse":
            raise ConfigError(
                f"reward: {resolved.config.reward!r} is not that of the reversed episodes of a "
                "deconstruction; collect the expert's, or leave the reward at 'sparse'"
            )
        super().__init__(resolved)

    def _build_scene(self, scale: float, *, window: bool | None = None) -> Scene:
        scene = super()._build_scene(scale, window=window)
        scene.task = Deconstruction(scene.task)
        return scene

    def _make_specs(self) -> None:
        super()._make_specs()
        undo = {
            UNDO_ACTION: Unbounded(self.action_spec.shape, device="cpu", dtype=torch.float32),
            CAN_UNDO: Binary(1, device="cpu", dtype=torch.bool),
        }
        if self.config.obs_type == "pixel":
            undo[UNDO_IN_HAND] = self.observation_spec[keys.IN_HAND].clone()
        self.observation_spec.update(undo)

    def _act(self, scene: Scene, action: np.ndarray) -> None:
        controller = scene.controller
        poses = {body: body.pose for body in scene.task.objects}
        before = UndoRecorder(poses, controller.held, controller.grasp)
        heights = self._heightmap(scene)
        super()._act(scene, action)
        self._memory = {name: value for name, value in self._memory.items() if name != "undo"}
        command = before.undo_command(controller.held, controller.grasp, scene.task.lowest_tool_m)
        if command is None:
            return
        undo = self.actions.encode(command)
        command, image = self.actions.decode(undo), None
        if before.held is not None:  # the inverse of a place is a pick, which has an in-hand image
            now = self._heightmap(scene)
            position = self._position(scene, command, PICK, now)
            image = self._draw_in_hand(now, heights, position, command)
        self._memory["undo"] = undo, image

    def _observe(self, scene: Scene) -> dict[str, Tensor]:
        observation = super()._observe(scene)
        action, image = self._memory.get("undo", (None, None))
        observation[CAN_UNDO] = torch.tensor([action is not None], device="cpu")
        if action is None:
            action = np.zeros(self.actions.size, dtype=np.float32)
        observation[UNDO_ACTION] = torch.from_numpy(action)
        if self.config.obs_type == "pixel":
            observation[UNDO_IN_HAND] = torch.zeros_like(observation[keys.IN_HAND])
            if image is not None:
                observation[UNDO_IN_HAND] = torch.from_numpy(image.astype(np.float32))
        return observation


def make_deconstruction_env(task: str, **config: Any) -> DeconstructionEnv:
    """Make an environment that takes structures apart.

    Args:
        task: id of an open-loop task with a structure.
    """
    check_has_structure(task)
    return DeconstructionEnv(resolve_env(task, config))


def is_reversible(episode: TensorDictBase) -> bool:
    """Return whether the reverse of a deconstruction episode [T] builds the structure.

    The episode must succeed, each of its actions must move exactly one object and be invertible,
    and picks and places must alternate, starting with a pick and ending with a place.
    """
    holding = episode[keys.HOLDING].flatten().tolist()
    return (
        bool(episode[keys.NEXT, keys.SUCCESS][-1])
        and bool(episode[keys.NEXT, CAN_UNDO].all())
        and holding == [i % 2 == 1 for i in range(len(holding))]
        and not bool(episode[keys.NEXT, keys.HOLDING][-1])
    )


def reverse_episode(episode: TensorDictBase) -> TensorDict:
    """Return a deconstruction episode [T] reversed in time, which builds the structure.

    It has the entries of an expert's episode. Observations are in reverse order, actions are the
    inverse actions, and in-hand images are those of the inverse picks. The last step completes the
    structure, has the reward and terminates.
    """
    if not is_reversible(episode):
        raise ValueError("the episode cannot be reversed: an action moved no object, or several")
    steps = len(episode)
    following = episode[keys.NEXT]
    seen = [key for key in episode.keys() if key not in {*_ENDS, *_EXTRA, keys.ACTION, keys.NEXT}]  # noqa: SIM118 -- a TensorDict
    # the state before each reversed step is t + 1, the state after it is t; the last step first
    before, after = (side.select(*seen).flip(0).clone() for side in (following, episode))
    if keys.IN_HAND in seen:
        # the reversed episode picks the object held in state t from the scene of state t + 1
        shown = torch.where(
            episode[keys.HOLDING][..., None, None],
            following[UNDO_IN_HAND],
            episode[keys.IN_HAND],
        )
        after[keys.IN_HAND] = shown.flip(0)
        before[keys.IN_HAND] = torch.cat([following[keys.IN_HAND][-1:], shown[1:].flip(0)])
    count = torch.arange(steps, device="cpu")[:, None]
    last = count == steps - 1
    never = torch.zeros_like(last)
    for state, number, at_goal in ((before, count, never), (after, count + 1, last)):
        state.update(
            {
                keys.STEP_COUNT: number,
                keys.SUCCESS: at_goal,
                keys.TERMINATED: at_goal.clone(),
                keys.DONE: at_goal.clone(),
                keys.TRUNCATED: never.clone(),
                keys.FAULT: never.clone(),
            }
        )
    after[keys.REWARD] = last.to(torch.float32)
    before[keys.ACTION] = following[UNDO_ACTION].flip(0)
    before[keys.NEXT] = after
    return before


class ReplayScores(NamedTuple):
    """Results of reversed episodes that are replayed in the simulator."""

    reversible: float
    """Fraction of the deconstruction episodes that can be reversed."""
    success_rate: float
    """Fraction of the reversible episodes whose inverse actions reach the goal."""
    mean_length: float


def replay_scores(task: str, episodes: int, *, seed: int = 0, **config: Any) -> ReplayScores:
    """Take structures apart, play the reversed actions, and return how often they build again."""
    env = make_deconstruction_env(task, **{**config, "seed": seed, "expert": True})
    lengths, reached = [], 0
    try:
        for _ in range(episodes):
            episode = env.rollout(
                env.max_steps, lambda td: td.set(keys.ACTION, td[keys.EXPERT_ACTION].clone())
            )
            if not is_reversible(episode):
                continue
            actions = reverse_episode(episode)[keys.ACTION]
            lengths.append(len(actions))
            reached += _play(env, actions)
    finally:
        env.close()
    kept = len(lengths)
    if not kept:
        return ReplayScores(0.0, 0.0, float("nan"))
    return ReplayScores(kept / episodes, reached / kept, sum(lengths) / kept)


def _play(env: DeconstructionEnv, actions: Tensor) -> bool:
    """Return whether actions [T, A] build the structure, completed by the last one."""
    scene = env.scene
    deconstruction, scene.task = scene.task, scene.task.task
    try:
        steps = [env.step(TensorDict({keys.ACTION: action}))[keys.NEXT] for action in actions]
    finally:
        scene.task = deconstruction
    return [bool(step[keys.SUCCESS]) for step in steps] == [False] * (len(steps) - 1) + [True]
