"""Where a policy fails, and what the task's expert would have done there.

Every state of every episode is saved. After a failed episode, the expert plays on from its states,
so that they are compared by what matters: how many steps the goal is away.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from tensordict import NonTensorData, TensorDict, TensorDictBase

from ba_torchrl.core import keys
from ba_torchrl.core.actions import CloseLoopActions
from ba_torchrl.envs.base import BulletArmEnv
from ba_torchrl.envs.carried import state_after
from ba_torchrl.envs.policies import Policy, expert_policy
from ba_torchrl.testing.labels import OPENING, Offset, label_jumps, nearest_offset, offset_of
from ba_torchrl.testing.progress import Disturbed, SceneView

Rounding = Callable[[torch.Tensor], torch.Tensor]

PIXELS = 256
"""Width of the height image of a failure."""
HOVER_M = 0.02
"""Largest extent of the tool's positions of a policy that hovers."""
HOVER_STEPS = 8
"""Number of last steps in which it does."""
GRIPPER_STEPS = 3
"""Number of states with another action of the gripper than the expert's that make a kind."""

EXPERT_FAILS = "the expert fails, too"
OUT_OF_STEPS = "runs out of steps"
REPEATS = "repeats itself"
MISSES = "misses the pick"
OTHER_OBJECT = "picks another object"
PLACES_OFF = "places off"
SPOILS = "spoils the scene"
LOSES = "lets go of the object"
CLOSES_EARLY = "closes on nothing"
KEEPS_OPEN = "keeps the gripper open"
HOVERS = "hovers"
WANDERS = "moves elsewhere"
_OFTEN = f"in {GRIPPER_STEPS} or more states without an object, the gripper"
KINDS = {
    EXPERT_FAILS: "the expert reaches the goal from none of the states",
    OUT_OF_STEPS: "fewer steps were left in the failing state than the expert needs",
    REPEATS: "the last action was sent into the same scene before",
    MISSES: "nothing is held after the pick",
    OTHER_OBJECT: "the pick holds an object that brings the goal no nearer",
    PLACES_OFF: "the place brings the goal no nearer",
    SPOILS: "the expert does not reach the goal from the last state",
    LOSES: "an object was held, and none is at the end",
    CLOSES_EARLY: f"{_OFTEN} closed where the expert opens it",
    KEEPS_OPEN: f"{_OFTEN} stayed open where the expert closes it",
    HOVERS: f"the tool stays within {100 * HOVER_M:.0f} cm in the last {HOVER_STEPS} steps",
    WANDERS: "none of the others",
}
"""The kinds of failures, and what makes a failure one of a kind. In open loop, the action in the
failing state decides, in close loop the steps from there on. The first kind that fits counts."""


class Stage(NamedTuple):
    """The part of a task that a state belongs to."""

    name: str
    """Open loop: pick or place. Close loop: empty or holding, what the gripper is."""
    number: int | None = None
    """Which pick or place of the expert's, from 1; None in close loop and if the expert fails."""
    total: int | None = None
    """Number of the expert's picks or places from the start of the episode."""

    def __str__(self) -> str:
        return self.name if self.number is None else f"{self.name} {self.number} of {self.total}"


@dataclass(frozen=True)
class StateRow:
    """One state of an episode, and the actions in it."""

    seed: int
    step: int
    stage: str
    policy: Offset
    """Of the policy's action from the expert's, or from the nearest move that is as good."""
    rounded: Offset | None
    """Of the expert's action on the policy's grid from the exact one; None without a grid."""
    jumps: bool
    """Whether the expert's action changes with the last bits of the state."""


class Arrow(NamedTuple):
    """An action as a pose of the tool."""

    who: str
    x_m: float
    y_m: float
    yaw_rad: float
    text: str


@dataclass(frozen=True)
class Picture:
    """What a failing state looks like."""

    heights: np.ndarray
    """[N, N] metres; rows follow x, columns y."""
    x_m: tuple[float, float]
    y_m: tuple[float, float]
    """Ranges that the height image shows."""
    rgb: np.ndarray
    """[H, W, 3] uint8."""
    tool: tuple[float, float, float] | None
    """Position and yaw of the tool; None in open loop, where it has no place between actions."""
    arrows: Sequence[Arrow]
    finger_gap_m: float


@dataclass(frozen=True)
class Failure:
    """A failed episode: the first of its states that were nearest to the goal."""

    kind: str
    seed: int
    steps: int
    """Length of the episode."""
    step: int
    """Of the state, from 0."""
    stage: Stage
    to_go: int | None
    """The expert's number of steps from the state to the goal; None if it does not reach it."""
    unmet: tuple[str, ...]
    """Conditions of success that do not hold in the state."""
    policy: Offset
    rounded: Offset | None
    jumps: bool
    successes: dict[str, bool]
    """Whether the goal is reached from the state by the expert, by the expert with every action on
    the policy's grid, by the expert after one action of the policy, and by the policy. Each has the
    task's full number of steps."""
    picture: Picture


@dataclass
class Diagnosis:
    """Episodes of a policy, and what is known about those that failed."""

    task: str
    episodes: int = 0
    solved: int = 0
    faults: int = 0
    """Episodes with a simulator fault, which are left out."""
    states: list[StateRow] = dataclasses.field(default_factory=list)
    failures: list[Failure] = dataclasses.field(default_factory=list)


class _Played(NamedTuple):
    """An episode from a saved state on."""

    is_solved: bool
    holding: tuple[bool, ...]
    """Whether an object was held before each step."""


@dataclass
class _Episode:
    """The states of an episode of the policy, and the actions in them."""

    seed: int
    saved: list[TensorDictBase]
    """One more than actions, but for a last scene that is invalid."""
    actions: list[np.ndarray]
    labels: list[np.ndarray]
    rows: list[StateRow]
    views: list[SceneView]
    tools: list[tuple[float, float, float]]
    holding: list[bool]


def diagnose(
    env: BulletArmEnv,
    policy: Policy,
    seeds: Sequence[int],
    rounding: Rounding | None = None,
    on_episode: Callable[[], object] = lambda: None,
) -> Diagnosis:
    """Play episodes of a policy, and compare it with the expert where it fails.

    Args:
        env: with ``expert=True``.
        policy: writes the action, and is deterministic.
        seeds: of the episodes.
        rounding: returns the actions [A] on the policy's grid that are nearest to others; None if
            the policy has no grid.
        on_episode: called after each episode.
    """
    found = Diagnosis(env.task_id)
    examiner = _Examiner(env, policy, rounding)
    for seed in seeds:
        examiner.examine(seed, found)
        on_episode()
    return found


class _Examiner:
    """Plays and examines episodes of a policy."""

    def __init__(self, env: BulletArmEnv, policy: Policy, rounding: Rounding | None) -> None:
        self.env, self.policy, self.rounding = env, policy, rounding
        self.rng = np.random.default_rng(0)
        self.is_close_loop = isinstance(env.actions, CloseLoopActions)

    @torch.no_grad()
    def examine(self, seed: int, found: Diagnosis) -> None:
        """Play an episode; add its states and its failure."""
        played, last = self._play(seed)
        if last[keys.FAULT]:
            found.faults += 1
            return
        found.episodes += 1
        found.states += played.rows
        if last[keys.SUCCESS]:
            found.solved += 1
        else:
            found.failures.append(self._failure(played))

    def _play(self, seed: int) -> tuple[_Episode, TensorDictBase]:
        """Return an episode, and the entries of its last step."""
        env, played = self.env, _Episode(seed, [], [], [], [], [], [], [])
        state = env.reset(seed=seed)
        while True:
            self._note(played, state)
            if state[keys.DONE]:
                return played, state
            jumps = label_jumps(env, played.saved[-1], self.rng)
            acted = self.policy(state.clone())
            action, label = acted[keys.ACTION], state[keys.EXPERT_ACTION]
            policy, rounded = self._offsets(action, state)
            name = self._stage_name(bool(state[keys.HOLDING]))
            row = StateRow(seed, len(played.actions), name, policy, rounded, jumps)
            played.rows.append(row)
            played.actions.append(action.numpy())
            played.labels.append(label.numpy())
            state = state_after(env.step(acted))
            if state[keys.FAULT]:
                return played, state

    def _note(self, played: _Episode, state: TensorDictBase) -> None:
        """Add what there is of the present state to an episode."""
        scene = self.env.scene
        if not state[keys.TERMINATED] or self.env.task_class.terminates_at_limit:
            played.saved.append(self.env.get_state())
        played.views.append(SceneView.of(scene))
        played.tools.append(scene.robot.tool_pose()[0])
        played.holding.append(bool(state[keys.HOLDING]))

    def _failure(self, played: _Episode) -> Failure:
        """Return what is known about a failed episode."""
        step, to_go = self._nearest(played)
        saved = played.saved[step]
        by_expert = self._play_on(saved, expert_policy)
        state = self._restore(saved)
        unmet = tuple(name for name, holds in self.env.conditions.items() if not holds)
        label = state[keys.EXPERT_ACTION]
        if step < len(played.actions):
            action = torch.from_numpy(played.actions[step])
        else:  # the episode ended in its failing state
            action = self.policy(state.clone())[keys.ACTION]
        jumps = label_jumps(self.env, saved, self.rng)
        policy, rounded = self._offsets(action, state)
        picture = self._picture(action, label)
        after = self._step(saved, action)
        is_solved_after = bool(after[keys.SUCCESS])
        if not after[keys.DONE]:
            rest = self._play_on(self.env.get_state(), expert_policy)
            is_solved_after = rest.is_solved
        successes = {"expert": by_expert.is_solved}
        if self.rounding is not None:
            successes["rounded expert"] = self._play_on(saved, self._rounded_expert).is_solved
        successes["policy, then expert"] = is_solved_after
        successes["policy"] = self._play_on(saved, self._same_bits).is_solved
        if to_go is None:
            kind = EXPERT_FAILS
        elif self.env.max_steps - step < to_go:
            kind = OUT_OF_STEPS
        elif self._repeats(played):
            kind = REPEATS
        elif self.is_close_loop:
            kind = self._motion(played, step)
        elif played.holding[step]:
            kind = PLACES_OFF
        else:
            kind = OTHER_OBJECT if after[keys.HOLDING] else MISSES
        return Failure(
            kind,
            played.seed,
            len(played.actions),
            step,
            self._stage(played, step, by_expert),
            to_go,
            unmet,
            policy,
            rounded,
            jumps,
            successes,
            picture,
        )

    # -- the failing state -------------------------------------------------------------------

    def _nearest(self, played: _Episode) -> tuple[int, int | None]:
        """Return the first of the states from which the expert needs the fewest steps, and their
        number; the first state of all if the expert reaches the goal from none."""
        step, fewest = 0, None
        for i in reversed(range(len(played.saved))):  # the last ones are nearer, and played in full
            from_here = self._play_on(played.saved[i], expert_policy, fewest)
            if from_here.is_solved:
                step, fewest = i, len(from_here.holding)
        return step, fewest

    def _play_on(self, saved: TensorDictBase, policy: Policy, limit: int | None = None) -> _Played:
        """Play at most ``limit`` steps from a saved state, by default the task's number."""
        state, holding = self._restore(saved), []
        while len(holding) < (limit or self.env.max_steps):
            holding.append(bool(state[keys.HOLDING]))
            state = state_after(self.env.step(policy(state)))
            if state[keys.DONE]:
                break
        return _Played(bool(state[keys.SUCCESS]), tuple(holding))

    def _step(self, saved: TensorDictBase, action: torch.Tensor) -> TensorDictBase:
        state = self._restore(saved)
        return self.env.step(state.set(keys.ACTION, action))[keys.NEXT]

    def _restore(self, saved: TensorDictBase) -> TensorDictBase:
        """Restore a saved state as if it were the first of an episode."""
        first = dataclasses.replace(saved[keys.STATE], step_count=0, ends={})
        return self.env.reset(TensorDict({keys.STATE: NonTensorData(first)}, []), set_state=True)

    def _same_bits(self, state: TensorDictBase) -> TensorDictBase:
        """Act as the policy did in its episode, in which every state was saved."""
        self.env.get_state()
        return self.policy(state)

    def _rounded_expert(self, state: TensorDictBase) -> TensorDictBase:
        return state.set(keys.ACTION, self.rounding(state[keys.EXPERT_ACTION]))

    # -- what it is --------------------------------------------------------------------------

    def _offsets(self, action: torch.Tensor, state: TensorDictBase) -> tuple[Offset, Offset | None]:
        """Return the offsets of the policy's action from the nearest of the expert's equal moves,
        and of the rounded label from the label."""
        actions, label = self.env.actions, state[keys.EXPERT_ACTION]
        labels = state.get(keys.EXPERT_MOVES, label[None])
        policy = nearest_offset(actions, action.numpy(), labels.unique(dim=0).numpy())
        if self.rounding is None:
            return policy, None
        return policy, offset_of(actions, self.rounding(label).numpy(), label.numpy())

    def _stage_name(self, is_holding: bool) -> str:
        names = ("empty", "holding") if self.is_close_loop else ("pick", "place")
        return names[is_holding]

    def _stage(self, played: _Episode, step: int, by_expert: _Played) -> Stage:
        """Return the stage of a state, from which the expert played on."""
        is_holding = played.holding[step]
        name = self._stage_name(is_holding)
        if self.is_close_loop or not by_expert.is_solved:
            return Stage(name)
        whole = self._play_on(played.saved[0], expert_policy).holding.count(is_holding)
        rest = by_expert.holding.count(is_holding)
        return Stage(name, max(whole - rest, 0) + 1, max(whole, rest))

    def _repeats(self, played: _Episode) -> bool:
        """Whether the last action was sent into the same scene before."""
        ranges = np.array(self._ranges())
        shares = [(action - ranges[0]) / (ranges[1] - ranges[0]) for action in played.actions]
        steps = Disturbed(played.views[: len(shares)], shares, False, False, 0)
        return bool(steps.repetitions(len(shares) - 1))

    def _ranges(self) -> tuple[np.ndarray, np.ndarray]:
        space = self.env.action_spec.space
        return space.low.numpy(), space.high.numpy()

    def _motion(self, played: _Episode, step: int) -> str:
        """Return the kind of a failure in close loop."""
        is_saved = len(played.saved) > len(played.actions)
        if not is_saved or not self._play_on(played.saved[-1], expert_policy).is_solved:
            return SPOILS
        if played.holding[step] and not played.holding[-1]:
            return LOSES
        openings = [
            [self.env.actions.decode(action).opening for action in actions[step:]]
            for actions in (played.actions, played.labels)
        ]
        late = np.subtract(*openings) * np.logical_not(played.holding[step:-1])
        early = np.subtract(*reversed(openings)) * np.logical_not(played.holding[step + 1 :])
        wrong = {KEEPS_OPEN: (late > OPENING).sum(), CLOSES_EARLY: (early > OPENING).sum()}
        most = max(wrong, key=wrong.get)
        if wrong[most] >= GRIPPER_STEPS:
            return most
        last = np.array(played.tools[step:][-HOVER_STEPS:])
        is_near = len(last) == HOVER_STEPS and np.ptp(last, axis=0).max() < HOVER_M
        return HOVERS if is_near else WANDERS

    # -- what it looks like ------------------------------------------------------------------

    def _picture(self, action: torch.Tensor, label: torch.Tensor) -> Picture:
        """Return the picture of the present state."""
        env, scene = self.env, self.env.scene
        (x, y, _), yaw = scene.robot.tool_pose()
        tool = (x, y, yaw) if self.is_close_loop else None
        shown = {"expert": label, "policy": action}
        if self.rounding is not None:
            shown["rounded expert"] = self.rounding(label)
        heights = scene.camera.heightmap(env.workspace.center, env.workspace.width, PIXELS)
        half = env.workspace.width / 2
        x_m, y_m = ((center - half, center + half) for center in env.workspace.center)
        arrows = [self._arrow(who, value.numpy(), tool) for who, value in shown.items()]
        gap_m = scene.robot.gripper.half_gap_m
        return Picture(heights, x_m, y_m, env.render(), tool, arrows, gap_m)

    def _arrow(
        self, who: str, action: np.ndarray, tool: tuple[float, float, float] | None
    ) -> Arrow:
        command = self.env.actions.decode(action)
        if tool is None:
            z = "" if command.z_m is None else f", z {1000 * command.z_m:.0f} mm"
            yaw = command.rz_rad
            text = f"x {1000 * command.x_m:.0f}, y {1000 * command.y_m:.0f} mm{z}"
            return Arrow(who, command.x_m, command.y_m, yaw, f"{text}, {math.degrees(yaw):.0f}°")
        x, y, yaw = tool
        moves = "x {:+.0f}, y {:+.0f}, z {:+.0f} mm".format(*(1000 * part for part in command[1:4]))
        turn = f"{math.degrees(command.dyaw_rad):+.0f}°"
        grip = "closes" if command.opening < 0.5 else "opens"
        at = x + command.dx_m, y + command.dy_m, yaw + command.dyaw_rad
        return Arrow(who, *at, f"{moves}, {turn}, {grip}")
