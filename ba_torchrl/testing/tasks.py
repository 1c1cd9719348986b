"""Contract checks of tasks; each raises an `AssertionError` that states the reason.

`check_task` runs all checks for the id of a task. The control is that of the task's class, so the
id is arbitrary.
"""

from __future__ import annotations

import functools
import math
import pickle
import warnings
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import check_env_specs

from ba_torchrl import make_vector_env
from ba_torchrl.core import keys
from ba_torchrl.envs.base import BulletArmEnv
from ba_torchrl.envs.policies import Policy, expert_policy
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.testing.episodes import (
    MAX_EPISODE_STEPS,
    action_at,
    continues,
    image_of,
    make_small,
    play_expert,
    random_actions,
)
from ba_torchrl.testing.labels import label_jump_share
from ba_torchrl.testing.progress import check_progress

POLICY_NOISE = 0.1
"""Standard deviation of the actions of a learned policy, as a share of the range of a component."""
MAX_NOISE_LOSS = 0.3
"""Largest difference of an expert's success rates without and with this noise that gives no
warning; that of the package's close-loop tasks is at most 0.1."""
MAX_LABEL_JUMPS = 0.1
"""Largest share of label jumps that gives no warning; that of 29 of the package's 31
tasks is at most 0.05, and ``ramp/improvise_*`` were not measured."""
JUMP_EPISODES = 3
"""Most episodes in whose states the expert is asked again."""


class ExpertReport(NamedTuple):
    """How often an expert succeeds, in how many steps, and whether a policy can imitate it."""

    task: str
    """Id of the task."""
    success_rate: float
    """Share of solved episodes."""
    mean_steps: float
    """Mean number of steps of solved episodes."""
    noisy_success_rate: float | None
    """Share of episodes that are solved with Gaussian noise of `POLICY_NOISE`, about that of a
    learned policy. None in open loop, where a policy chooses a pixel."""

    label_jumps: float = 0.0
    """Share of states in which the expert's action changes with the last bits of the state; see
    `ba_torchrl.testing.labels`."""

    @property
    def warning(self) -> str | None:
        """What to change if noise lowers the success rate by more than `MAX_NOISE_LOSS`, or if more
        than `MAX_LABEL_JUMPS` of the expert's actions jump."""
        found, noisy = [], self.noisy_success_rate
        if noisy is not None and noisy < self.success_rate - MAX_NOISE_LOSS:
            found.append(
                f"{self.task}: the expert solves {self.success_rate:.2f} of its episodes, and "
                f"{noisy:.2f} with the noise of a learned policy, which will hardly imitate it. "
                "Widen the tolerances of `evaluate` and the thresholds between the expert's phases"
            )
        if self.label_jumps > MAX_LABEL_JUMPS:
            found.append(
                f"{self.task}: in {self.label_jumps:.2f} of the states, the expert's action jumps "
                "with the last bits of the state, which no policy sees. Let the expert prefer one "
                "of several equal choices by a margin"
            )
        return "\n".join(found) or None

    def __str__(self) -> str:
        text = f"{self.task}: the expert solves {self.success_rate:.2f} of its episodes in "
        text += f"{self.mean_steps:.1f} steps"
        if self.noisy_success_rate is not None:
            text += f", and {self.noisy_success_rate:.2f} with the noise of a learned policy"
        text += f"; its action jumps with the last bits of {self.label_jumps:.2f} of the states"
        return text if self.warning is None else f"{text}\nwarning: {self.warning}"


def check_task(
    task: str,
    *,
    robot: str = "kuka",
    episodes: int = 10,
    min_success_rate: float = 0.9,
    min_recovery_rate: float = 0.85,
    max_typical_steps: float | None = None,
) -> ExpertReport:
    """Check that a task fulfils the contract of this package's tasks; takes about a minute.

    An expert passes with a warning if its success depends on exact actions, or if its actions jump
    with the last bits of the state.

    Args:
        episodes: number of episodes that the expert plays, both from the start and after random
            actions.
        min_success_rate: of the expert from the start.
        min_recovery_rate: of the expert after random actions.
        max_typical_steps: largest mean (close loop) or median (open loop) number of the expert's
            steps; None for no limit.

    Returns:
        The expert's results, which print as a sentence.

    Raises:
        AssertionError: a check fails; the message states the reason.
        ConfigError: the task is unknown.
        Exception: the task's code raises it.
    """
    for check in CHECKS:
        check(task, robot=robot)
    report = check_expert(
        task,
        episodes=episodes,
        min_success_rate=min_success_rate,
        max_typical_steps=max_typical_steps,
        robot=robot,
    )
    check_recovery(task, episodes=episodes, min_success_rate=min_recovery_rate, robot=robot)
    check_progress(task, episodes=episodes, robot=robot)
    if TASKS[task].control == "close_loop":
        rate = noisy_success_rate(task, episodes=episodes, robot=robot)
        report = report._replace(noisy_success_rate=rate)
    jumps = label_jump_share(task, episodes=min(episodes, JUMP_EPISODES), robot=robot)
    report = report._replace(label_jumps=jumps)
    if report.warning is not None:
        warnings.warn(report.warning, stacklevel=2)
    return report


def check_specs(task: str, **config: Any) -> None:
    """Check that observations, actions and done flags match the environment's specs."""
    with closing(make_small(task, expert=True, max_steps=2, **config)) as env:
        check_env_specs(env, break_when_any_done="both", seed=0)


def check_vector_specs(task: str, *, parallel: bool = False, **config: Any) -> None:
    """Check the specs of two environments that step together."""
    config = {"obs_size": 32, "seed": 0, "expert": True, "max_steps": 2, **config}
    vector = make_vector_env(task, 2, parallel=parallel, start_method="fork", **config)
    with closing(vector) as env:
        check_env_specs(env, break_when_any_done="both", seed=0)


def check_resets(task: str, *, episodes: int = 5, **config: Any) -> None:
    """Check that an episode starts in a valid scene whose goal does not hold."""
    with closing(make_small(task, **config)) as env:
        for episode in range(episodes):
            state = env.reset()
            where = f"{task}, episode {episode}"
            assert not env.scene.task.is_success(), f"{where}: the goal holds at the start"
            assert env.scene.task.is_valid(), f"{where}: the scene is invalid at the start"
            assert not state[keys.DONE], f"{where}: done at the start"
            assert not state[keys.SUCCESS], f"{where}: success at the start"
            assert state[keys.STEP_COUNT] == 0, f"{where}: the step count does not start at 0"
            words = env.instruction
            assert words[:1].islower(), f"{where}: the instruction begins with no verb: {words!r}"
            assert not words.endswith("."), f"{where}: the instruction ends with a stop: {words!r}"


def check_seeds(task: str, **config: Any) -> None:
    """Check that a seed determines the images bit for bit, also in an environment whose maker was
    sent to another process, and that another seed changes them, as does the next episode, unless
    the task continues the scene."""
    make_env = functools.partial(make_small, task, **config)
    sent = pickle.loads(pickle.dumps(make_env))
    with closing(make_env()) as first, closing(sent()) as second:
        policy = _constant_policy(first, 0.65, 0.25, 0.85, 0.0, 0.6)
        a, b = (image_of(env.rollout(4, policy)[keys.NEXT]) for env in (first, second))
        assert torch.equal(a, b), f"{task}: two environments with the same seed differ"
        first.set_seed(0)
        again = first.rollout(4, policy)
        assert torch.equal(image_of(again[keys.NEXT]), a), (
            f"{task}: the same seed gives another episode the second time"
        )
        other = image_of(first.reset(seed=1))
        assert not torch.equal(other, image_of(again)[0]), f"{task}: the seed changes nothing"
        assert continues(task) or not torch.equal(image_of(first.reset()), other), (
            f"{task}: two episodes start from the same scene"
        )


def check_observations_are_copies(task: str, **config: Any) -> None:
    """Check that a step does not modify images that were returned earlier."""
    with closing(make_small(task, expert=True, **config)) as env:
        state = env.reset()
        while True:
            kept, copy = image_of(state), image_of(state).clone()
            following = env.step(expert_policy(state))[keys.NEXT]
            assert not following[keys.FAULT], f"{task}: a simulator fault, which the log shows"
            assert torch.equal(kept, copy), f"{task}: a step changed an image returned before it"
            if following[keys.DONE]:
                break
            state = following
        assert not torch.equal(copy, image_of(following)), f"{task}: the image never changes"


def check_any_actions(task: str, *, episodes: int = 1, **config: Any) -> None:
    """Check that random actions, and those at the bounds of their ranges, cause no fault and no
    observation outside its spec."""
    with closing(make_small(task, **config)) as env:
        rng = np.random.default_rng(0)

        def extreme(tensordict: TensorDictBase) -> TensorDictBase:
            fractions = rng.integers(0, 2, 7).astype(np.float32).tolist()
            return tensordict.set(keys.ACTION, action_at(env, fractions))

        torch.manual_seed(0)
        for policy in (None, extreme) * episodes:
            last = env.rollout(50, policy)[keys.NEXT].select(*env.observation_spec.keys())[-1]
            assert env.observation_spec.is_in(last), f"{task}: an observation is out of its spec"
        assert env.faults == 0, f"{task}: {env.faults} simulator faults under any actions"


def check_step_limit(task: str, **config: Any) -> None:
    """Check that the step limit truncates, unless the task terminates there."""
    if TASKS[task].terminates_at_limit:
        return
    with closing(make_small(task, max_steps=3, **config)) as env:
        # close loop: no motion, gripper open; open loop: a place without an object
        action = action_at(env, [0.5])
        action[0] = 1.0
        rollout = env.rollout(10, lambda td: td.set(keys.ACTION, action.clone()))
    assert len(rollout) == 3, f"{task}: {len(rollout)} steps with max_steps=3"
    last = rollout[keys.NEXT][-1]
    assert last[keys.TRUNCATED], f"{task}: the step limit does not truncate"
    assert last[keys.DONE], f"{task}: truncated, but not done"
    assert not last[keys.TERMINATED], f"{task}: the step limit terminates"
    counts = rollout[keys.NEXT, keys.STEP_COUNT].flatten().tolist()
    assert counts == [1, 2, 3], f"{task}: the step counts are {counts}"


def check_expert(
    task: str,
    *,
    episodes: int,
    min_success_rate: float,
    max_typical_steps: float | None = None,
    **config: Any,
) -> ExpertReport:
    """Check the expert's success rate and steps, and the rewards and ends of its episodes.

    ``max_typical_steps`` is the largest mean (close loop) or median (open loop) number of steps of
    solved episodes; None for no limit.
    """
    with closing(make_small(task, expert=True, **config)) as env:
        played = play_expert(env, episodes)
        faults = env.faults
    assert faults == 0, f"{task}: {faults} simulator faults, which the log shows"
    lengths = [len(episode) for episode in played if episode[keys.NEXT, keys.SUCCESS][-1]]
    assert len(lengths) >= min_success_rate * episodes, (
        f"{task}: the expert solves {len(lengths)} of {episodes} episodes, "
        f"a success rate below {min_success_rate:g}"
    )
    if max_typical_steps is not None:
        typical = np.mean if TASKS[task].control == "close_loop" else np.median
        steps = typical(lengths)
        assert steps <= max_typical_steps, (
            f"{task}: the expert needs {steps:.1f} steps ({typical.__name__}), "
            f"more than {max_typical_steps:g}"
        )
    for episode in played:
        following = episode[keys.NEXT]
        assert torch.equal(following[keys.REWARD], following[keys.SUCCESS].float()), (
            f"{task}: the reward is not 1 on success and 0 otherwise"
        )
        assert not following[keys.DONE][:-1].any(), f"{task}: steps follow one that is done"
        assert following[keys.TERMINATED][-1] or following[keys.TRUNCATED][-1], (
            f"{task}: an episode has not ended after {MAX_EPISODE_STEPS} steps"
        )
    mean_steps = float(np.mean(lengths)) if lengths else math.nan
    return ExpertReport(task, len(lengths) / episodes, mean_steps, None)


def noisy_success_rate(task: str, *, episodes: int, **config: Any) -> float:
    """Return the expert's success rate with Gaussian noise of `POLICY_NOISE`."""
    with closing(make_small(task, expert=True, **config)) as env:
        played = play_expert(env, episodes, noise=POLICY_NOISE)
    return float(np.mean([bool(episode[keys.NEXT, keys.SUCCESS][-1]) for episode in played]))


def check_recovery(task: str, *, episodes: int, min_success_rate: float, **config: Any) -> None:
    """Check the expert's success rate after random actions; one-step tasks are exempt.

    Episodes that end during the random actions do not count.
    """
    if TASKS[task].terminates_at_limit:
        return
    with closing(make_small(task, expert=True, **config)) as env:
        outcomes: list[bool] = []
        for seed in range(2 * episodes):
            success = _recover(env, seed)
            if success is not None:
                outcomes.append(success)
            if len(outcomes) == episodes:
                break
    assert len(outcomes) >= episodes / 2, f"{task}: random actions end most episodes"
    assert np.mean(outcomes) >= min_success_rate, (
        f"{task}: after random actions the expert solves {sum(outcomes)} of "
        f"{len(outcomes)} episodes, a success rate below {min_success_rate:g}"
    )


def check_expert_is_passive(task: str, **config: Any) -> None:
    """Check that computing the expert's action does not change the episode."""
    make_env = functools.partial(make_small, task, **config)
    with closing(make_env(expert=True)) as computed, closing(make_env()) as plain:
        policy = _constant_policy(plain, 0.0, 0.7, 0.7, 0.05, 0.55)
        a, b = (image_of(env.rollout(6, policy)[keys.NEXT]) for env in (computed, plain))
        assert torch.equal(a, b), f"{task}: computing the expert's action changes the episode"
        for _ in range(5):
            computed.scene.task.expert_command()
        position = computed.scene.robot.tool_pose()[0]
        assert all(map(math.isfinite, position)), f"{task}: the expert moved the robot"


def check_partial_resets(task: str, **config: Any) -> None:
    """Check that a reset of one environment of a vector does not affect the other."""
    config = {"obs_size": 32, "seed": 0, **config}
    with closing(make_vector_env(task, 2, parallel=False, **config)) as env:
        state = env.reset()
        space = env.action_spec.space
        state = env.step(state.set(keys.ACTION, (space.low + space.high) / 2))[keys.NEXT]
        before = image_of(state).clone()
        state["_reset"] = torch.tensor([[True], [False]])
        after = env.reset(state)
    counts = after[keys.STEP_COUNT].flatten().tolist()
    assert counts == [0, 1], f"{task}: step counts {counts} after a reset of the first environment"
    assert torch.equal(image_of(after)[1], before[1]), (
        f"{task}: the reset of one environment changed the image of another"
    )
    if TASKS[task].control == "close_loop" and not continues(task):
        assert not torch.equal(image_of(after)[0], before[0]), (
            f"{task}: the environment that was reset shows the same scene"
        )


CHECKS = (
    check_specs,
    check_vector_specs,
    check_resets,
    check_seeds,
    check_observations_are_copies,
    check_any_actions,
    check_step_limit,
    check_expert_is_passive,
    check_partial_resets,
)
"""The checks of `check_task` that count no successes."""

# -- parts -----------------------------------------------------------------------------------


def _constant_policy(env: BulletArmEnv, *fractions: float) -> Policy:
    return lambda td: td.set(keys.ACTION, action_at(env, fractions))


def _recover(env: BulletArmEnv, seed: int) -> bool | None:
    """Return the expert's success after random actions; None if these end the episode."""
    state = random_actions(env, env.reset(seed=seed), np.random.default_rng(seed))
    if state[keys.DONE]:
        return None
    while not state[keys.DONE]:
        state = env.step(expert_policy(state))[keys.NEXT]
    return bool(state[keys.SUCCESS])
