"""Run cases and record their tensors: a digest of the bits, and the numbers or their sum."""

from __future__ import annotations

import csv
import hashlib
import importlib.metadata
import logging
import multiprocessing
import os
import random
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp
from tqdm import tqdm

import ba_torchrl
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.registration import gym_id
from profiling.fingerprint.cases import CONFIGS, Case

VALUES = 16
"""Tensors of at most this many elements are recorded as numbers, larger ones as their sum."""
MAX_STEPS = 200
"""Upper bound on the length of an episode."""
TILT = 0.2
"""Random tilts, as a fraction of the largest ones."""
NOISE = 0.3
"""Standard deviation of the noise on expert actions, as a fraction of half the action's range."""
NOT_RECORDED = ("run_dir", "resume", "label")
"""Fields of a run's configuration that do not affect its numbers."""
WORDS = 12
"""Words of an error's message that are recorded."""
LIBRARIES = ("torch", "torchrl", "tensordict", "numpy", "pybullet", "numba", "scipy")
"""Packages whose versions the numbers depend on."""


def digest(*arrays: np.ndarray) -> str:
    """Return the first 64 bits of the SHA-256 of arrays, their types and shapes, in hexadecimal."""
    total = hashlib.sha256()
    for array in arrays:
        total.update(f"{array.dtype}{array.shape}".encode())
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()[:16]


def mark(value: torch.Tensor | np.ndarray | float) -> list[Any]:
    """Return the digest of a value, and its numbers or their sum."""
    array = np.asarray(value.detach().cpu() if isinstance(value, torch.Tensor) else value)
    if array.size <= VALUES:
        return [digest(array), [float(x) for x in array.flatten()]]
    return [digest(array), float(array.sum(dtype=np.float64))]


def marks(data: TensorDictBase) -> dict[str, list[Any]]:
    """Return the marks of all entries except those under "next"."""
    return {
        ".".join(key) if isinstance(key, tuple) else key: mark(data[key])
        for key in sorted(data.keys(include_nested=True, leaves_only=True), key=str)
        if key[0] != "next"
    }


def spec_facts(env: EnvBase) -> dict[str, str]:
    """Return type, shape and bounds of every entry of an environment's specifications."""

    def describe(spec: TensorSpec) -> str:
        text = f"{type(spec).__name__} {spec.dtype} {tuple(spec.shape)}"
        bounds = [getattr(spec.space, name, None) for name in ("low", "high")]
        if all(isinstance(bound, torch.Tensor) for bound in bounds):
            text += f" {digest(*(bound.numpy() for bound in bounds))}"
            text += f" {float(bounds[0].min()):g} to {float(bounds[1].max()):g}"
        return text

    groups = {
        "observation": env.full_observation_spec,
        "action": env.full_action_spec,
        "reward": env.full_reward_spec,
        "done": env.full_done_spec,
    }
    return {
        f"spec {group} {key}": describe(spec)
        for group, composite in groups.items()
        for key, spec in composite.items(include_nested=True, leaves_only=True)
    }


def tensors(state: Any) -> Iterator[torch.Tensor]:
    """Return the tensors in nested containers."""
    if isinstance(state, torch.Tensor):
        yield state
    elif isinstance(state, dict):
        for value in state.values():
            yield from tensors(value)
    elif isinstance(state, list | tuple):
        for value in state:
            yield from tensors(value)


def tensors_mark(state: Any) -> str:
    """Return the digest of a set of tensors, independent of their names and order."""
    arrays = [tensor.detach().cpu().numpy() for tensor in tensors(state)]
    digests = "".join(sorted(digest(array) for array in arrays))
    total = sum(float(np.abs(array.astype(np.float64)).sum()) for array in arrays)
    return (
        f"{hashlib.sha256(digests.encode()).hexdigest()[:16]}, {len(arrays)} tensors, "
        f"sum of magnitudes {total:.12g}"
    )


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
                data = env.reset(state.clone(), set_state=True).exclude("state")
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

    env = gymnasium.make(gym_id(case.task), expert=True, **case.config)
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


def _composed(case: Case, run_dir: str) -> dict[str, Any]:
    """Return the values that Hydra composes for a training run."""
    from omegaconf import OmegaConf

    from ba_torchrl.training.presets import composed

    overrides = dict(case.config)
    file = overrides.pop("file")
    overrides |= {"seed": case.seed, "run_dir": run_dir}
    chosen = [f"{name}={overrides[name]}" for name in overrides if (CONFIGS / name).is_dir()]
    with composed(CONFIGS, file, chosen) as settings:
        for name, value in overrides.items():
            if not (CONFIGS / name).is_dir():
                OmegaConf.update(settings, name, value)
        return OmegaConf.to_container(settings, resolve=True)


def _flat(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested dictionaries under dotted names."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def run_training(case: Case, facts: dict[str, Any], traces: dict[str, Any]) -> None:
    """Train for a few updates; record every scalar, the last parameters and the evaluation."""
    from ba_torchrl.training.config import ExperimentConfig
    from ba_torchrl.training.experiment import Experiment

    with tempfile.TemporaryDirectory() as folder:
        config = ExperimentConfig.parse(_composed(case, f"{folder}/run"))
        facts |= {
            f"config {name}": value
            for name, value in _flat(config.resolved())
            if name.split(".")[0] not in NOT_RECORDED
        }
        experiment = Experiment(config, progress=False)
        result = experiment.run()
        with (Path(folder) / "run" / "scalars.csv").open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    steps: dict[str, dict[str, Any]] = {}
    for row in rows:
        steps.setdefault(row["step"], {})[row["name"]] = [row["value"], [float(row["value"])]]
    traces["scalars"] = {"facts": {"updates": " ".join(steps)}, "steps": list(steps.values())}
    facts["updates"] = result.updates
    for name in ("episodes", "success_rate", "mean_length"):
        facts[f"evaluation {name}"] = getattr(result.last, name)
    learner = experiment.learner
    augmentation = learner.replay.transform.state_dict()
    for name, state in {**learner.state_dict(), "augmentation": augmentation}.items():
        if any(True for _ in tensors(state)):
            facts[f"tensors of {name}"] = tensors_mark(state)
    facts["tensors of the policy"] = tensors_mark(learner.policy.state_dict())


RUNNERS: dict[str, Callable[[Case, dict[str, Any], dict[str, Any]], None]] = {
    "env": run_env,
    "state": run_state,
    "vector": run_vector,
    "parallel": run_vector,
    "gym": run_gym,
    "training": run_training,
}


def run_case(case: Case) -> dict[str, Any]:
    """Run a case and return its record, also of a refused configuration or a failure."""
    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    torch.manual_seed(case.seed)
    np.random.seed(case.seed)  # noqa: NPY002 -- in case a library draws from it
    random.seed(case.seed)
    facts: dict[str, Any] = {}
    traces: dict[str, Any] = {}
    try:
        RUNNERS[case.kind](case, facts, traces)
    except ConfigError as error:
        facts["refused"] = _briefly(error)
    except Exception as error:
        facts["failed"] = f"{type(error).__name__}: {_briefly(error)}"
    return {"part": case.part, "task": case.task, "facts": facts, "traces": traces}


def run_all(wanted: list[Case], workers: int) -> dict[str, dict[str, Any]]:
    """Run cases in worker processes; return their records by name, in the order of the cases."""
    os.environ |= {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}  # for the processes
    context = multiprocessing.get_context("spawn")
    records = {}
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        futures = {pool.submit(run_case, case): case for case in wanted}
        interval_s = 0.1 if sys.stderr.isatty() else 10.0
        done = as_completed(futures)
        for future in tqdm(done, total=len(futures), unit="case", mininterval=interval_s):
            records[futures[future].name] = future.result()
    return {case.name: records[case.name] for case in wanted}


def versions() -> dict[str, str]:
    """Return the versions of the libraries that the numbers depend on."""
    installed = {dist.metadata["Name"].lower(): dist for dist in importlib.metadata.distributions()}
    return {name: installed[name].version if name in installed else "none" for name in LIBRARIES}


def _briefly(error: Exception) -> str:
    return " ".join(str(error).split()[:WORDS])
