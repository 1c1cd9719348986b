"""Record the steps of environments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

import ba_torchrl
from ba_torchrl.profiling.fingerprint.cases import Case
from ba_torchrl.profiling.fingerprint.marks import digest, mark, marks, spec_facts

MAX_STEPS = 200
"""Upper bound on the length of an episode."""
TILT = 0.2
"""Random tilts, as a fraction of the largest ones."""
NOISE = 0.3
"""Standard deviation of the noise on expert actions, as a fraction of half the action's range."""


class Actions:
    """Random actions within a specification, with a separate generator."""

    def __init__(self, spec: TensorSpec, seed: int, sequence: str = "") -> None:
        self.low = spec.space.low.numpy().astype(np.float64)
        self.high = spec.space.high.numpy().astype(np.float64)
        self.rng = np.random.default_rng(seed)
        self.tilts = [i for i, letter in enumerate(sequence) if letter == "r"][1:]

    def random(self) -> torch.Tensor:
        """Return an action that is uniform within the specification, its tilts small."""
        action = self.rng.uniform(self.low, self.high)
        action[..., self.tilts] *= TILT
        return torch.from_numpy(action.astype(np.float32))

    def near(self, expert: torch.Tensor) -> torch.Tensor:
        """Return the expert's action with noise on each component with probability 0.5."""
        noise = self.rng.normal(size=self.low.shape) * (self.high - self.low) / 2 * NOISE
        noise *= self.rng.random(self.low.shape) < 0.5
        action = np.clip(expert.numpy().astype(np.float64) + noise, self.low, self.high)
        return torch.from_numpy(action.astype(np.float32))


Choice = Callable[[TensorDictBase], torch.Tensor]


class Trace:
    """The record of a sequence of steps."""

    def __init__(self, traces: dict[str, Any], name: str) -> None:
        self.steps: list[dict[str, Any]] = []
        self.facts: dict[str, Any] = {}
        traces[name] = {"facts": self.facts, "steps": self.steps}

    def reset(self, env: EnvBase, **options: Any) -> TensorDictBase:
        """Reset the environment and record the result."""
        data = env.reset(**options)
        self.steps.append(marks(data))
        return data

    def step(self, env: EnvBase, data: TensorDictBase, action: torch.Tensor) -> TensorDictBase:
        """Take a step and record it; return the result of `torchrl.envs.EnvBase.step`."""
        data = env.step(data.set("action", action.clone()))
        self.steps.append({"action": mark(data["action"]), **marks(data["next"])})
        return data

    def end(self, data: TensorDictBase) -> None:
        """Record length and outcome of an episode."""
        self.facts["length"] = len(self.steps) - 1
        for key in ("success", "terminated", "truncated"):
            self.facts[key] = bool(data["next", key].item())


def _play_episode(env: EnvBase, trace: Trace, choose: Choice) -> None:
    data = trace.reset(env)
    for _ in range(MAX_STEPS):
        data = trace.step(env, data, choose(data))
        if data["next", "done"].item():
            break
        last, data = data, step_mdp(data)
    else:
        data = last
    trace.end(data)


def _play_steps(env: EnvBase, trace: Trace, choose: Choice, count: int) -> None:
    data = trace.reset(env)
    for _ in range(count):
        data = trace.step(env, data, choose(data))
        data = trace.reset(env) if data["next", "done"].item() else step_mdp(data)


def _expert(data: TensorDictBase) -> torch.Tensor:
    return data["expert_action"]


def _make(case: Case) -> EnvBase:
    return ba_torchrl.make(case.task, **{"seed": case.seed, "expert": True, **case.config})


def run_env(case: Case, facts: dict[str, Any], traces: dict[str, Any]) -> None:
    """Record expert episodes, random actions and noisy expert actions."""
    env = _make(case)
    try:
        facts |= spec_facts(env)
        facts["max_steps"] = env.max_steps
        actions = Actions(env.action_spec, case.seed, env.actions.sequence)
        for i in range(case.plan.get("expert", 0)):
            trace = Trace(traces, f"expert {i}")
            _play_episode(env, trace, _expert)
            if case.config.get("robot", "kuka") == "kuka" and "view_type" not in case.config:
                trace.facts["picture"] = digest(env.render(width=80, height=60))
        if "random" in case.plan:
            trace = Trace(traces, "random")
            _play_steps(env, trace, lambda _: actions.random(), case.plan["random"])
        if "near" in case.plan:
            trace = Trace(traces, "near")
            choose = lambda data: actions.near(_expert(data))  # noqa: E731
            _play_steps(env, trace, choose, case.plan["near"])
        facts["faults"] = env.faults
    finally:
        env.close()


def run_state(case: Case, facts: dict[str, Any], traces: dict[str, Any]) -> None:
    """Restore a state twice, each time with the same actions after it."""
    env = _make(case)
    try:
        actions = Actions(env.action_spec, case.seed, env.actions.sequence)
        trace = Trace(traces, "before")
        data = trace.reset(env)
        for _ in range(2):
            data = trace.step(env, data, _expert(data))
            if data["next", "done"].item():
                break
            data = step_mdp(data)
        state = env.get_state()
        future = [actions.random() for _ in range(3)]
        for name in ("after", "again", "once more"):
            trace = Trace(traces, name)
            if name != "after":
                data = env.set_state(state)
                trace.steps.append(marks(data))
            for action in [*future, None]:
                data = data if "next" not in data else step_mdp(data)
                if action is None and "expert_action" not in data:
                    break
                action = _expert(data) if action is None else action
                data = trace.step(env, data, action)
                if data["next", "done"].item():
                    break
            data = TensorDict({}, batch_size=[])
        facts["exact"] = traces["again"] == traces["once more"]
    finally:
        env.close()


def run_vector(case: Case, facts: dict[str, Any], traces: dict[str, Any]) -> None:
    """Step a vector of two environments, with partial resets."""
    env = ba_torchrl.make_vector_env(
        case.task,
        2,
        parallel=case.kind == "parallel",
        **{"seed": case.seed, "expert": True, **case.config},
    )
    try:
        facts |= spec_facts(env)
        trace = Trace(traces, "expert")
        data = trace.reset(env)
        for _ in range(10):
            data = trace.step(env, data, _expert(data))
            following = step_mdp(data)
            if data["next", "done"].any():
                following["_reset"] = following["done"].clone()
                data = trace.reset(env, tensordict=following)
            else:
                data = following
    finally:
        env.close()


def run_gym(case: Case, facts: dict[str, Any], traces: dict[str, Any]) -> None:
    """Take random actions through Gymnasium."""
    import gymnasium

    words = case.task.replace("/", "_").split("_")
    name = f"BulletArm/{''.join(word.capitalize() for word in words)}-v0"
    env = gymnasium.make(name, expert=True, **case.config)
    try:
        facts |= {"actions": str(env.action_space)}
        facts |= {f"observation {key}": str(s) for key, s in env.observation_space.items()}
        trace = Trace(traces, "random")
        rng = np.random.default_rng(case.seed)
        observation, info = env.reset(seed=case.seed)
        ends: tuple[Any, ...] = ()
        for i in range(6):
            step = {**observation, **{f"info.{key}": value for key, value in info.items()}}
            step |= dict(zip(("reward", "terminated", "truncated"), ends, strict=False))
            trace.steps.append({key: mark(value) for key, value in sorted(step.items())})
            if i == 5 or any(ends[1:]):
                break
            low, high = (
                b.astype(np.float64) for b in (env.action_space.low, env.action_space.high)
            )
            action = rng.uniform(low, high).astype(np.float32)
            observation, *ends, info = env.step(action)
    finally:
        env.close()
