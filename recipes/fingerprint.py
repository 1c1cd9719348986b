"""Record what environments and training compute, bit by bit, and compare with an earlier record.

python recipes/fingerprint.py --out before.json                  # every task, robot and option
python recipes/fingerprint.py --compare before.json              # exit code 1 if anything differs
python recipes/fingerprint.py --compare before.json --parts envs --tasks close_loop/block_picking
python recipes/fingerprint.py --compare before.json --match kuka # cases by a part of their name

For changes of the code that must not change what it computes. A record holds for each case the
first 64 bits of the SHA-256 of every tensor at every step, and the numbers of small tensors.
Records of other machines or other versions of the libraries may differ in the last bits.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import importlib.metadata
import json
import logging
import math
import multiprocessing
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
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
from ba_torchrl.errors import ConfigError

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
PARTS = ("envs", "training")
ROBOTS = ("kuka", "panda", "ur5", "ur5_robotiq")
SEED = 7
VALUES = 16
"""Tensors of at most this many elements are recorded as numbers, larger ones as their sum."""
WORDS = 12
"""Of an error's message."""
MAX_STEPS = 200
"""Of an episode, in case it does not end."""
TILT = 0.2
"""Random tilts are this share of the greatest ones."""
NOISE = 0.3
"""Standard deviation of the noise on expert actions, as a share of half the action's range."""

FOLLOWING_VIEWS = [f"camera_center_{axes}" for axes in ("xyz", "xyzr", "xyr", "xy", "z")]
HEIGHT_VIEWS = [*FOLLOWING_VIEWS, "camera_fix", "render_center", "camera_side"]
VIEWS = [
    *HEIGHT_VIEWS,
    *(f"{view}_height" for view in HEIGHT_VIEWS),
    "camera_side_rgbd",
    "pers_center_xyz",
]

OPTIONS: dict[str, dict[str, Any]] = {
    "vec": {"obs_type": "vec"},
    "rgb": {"rgb": True},
    "point_cloud": {"point_cloud": 256},
    "half_rotation": {"half_rotation": True},
    "whole_rotation": {"half_rotation": False},
    "bounding_box": {"workspace_check": "bounding_box"},
    "slow_motion": {"fast_mode": False},
    "slow_physics": {"physics_mode": "slow"},
    "custom_physics": {"physics_mode": "custom", "time_step_s": 1 / 300, "solver_iterations": 40},
    "fixed_yaw": {"random_orientation": False},
    "small_image": {"obs_size": 32},
    "three_steps": {"max_steps": 3},
    "one_scale": {"object_scale_range": 0.7},
    "colors": {"rgb": True, "floor_color": [0.2, 0.4, 0.1], "workspace_color": [0.9, 0.8, 0.7]},
    "cylinder": {"object_type": "cylinder"},
    "household": {"object_set": "household"},
    "deconstruct": {"deconstruct": True},
    "tray": {"close_loop_tray": True},
    "steps_of_control": {"dpos": 0.03, "drot": math.pi / 8},
    "view_scale": {"view_scale": 1.0},
    "in_hand_sub": {"in_hand_mode": "sub"},
    "in_hand_proj": {"in_hand_mode": "proj"},
    "in_hand_size": {"in_hand_size": 32},
    "top_down": {"top_down_approach": True},
    "top_down_tilted": {"top_down_approach": True, "action_sequence": "pxyzrrr"},
    "in_hand_sub_tilted": {"in_hand_mode": "sub", "action_sequence": "pxyzrrr"},
    "two_angles": {"action_sequence": "pxyzrr"},
    "no_primitive": {"action_sequence": "xyr"},
    "with_height": {"action_sequence": "pxyzr"},
    "other_order": {"action_sequence": "ryxp"},
    **{f"num_objects_{n}": {"num_objects": n} for n in (1, 2, 3, 4, 5, 8, 12, 18)},
}
"""Variants that are tried on every task of the robot kuka; what a task refuses is recorded."""
SLOW_TASKS = ("close_loop/object_grasping", "open_loop/bin_packing", "open_loop/object_grasping")
"""Every reset lets many objects come to rest; of these tasks fewer actions are recorded."""
VIEW_TASKS = ("close_loop/block_picking", "close_loop/drawer_opening")
STEPPED_TOGETHER = {"close_loop/block_stacking", "open_loop/house_building_1"}

CLOSE_LOOP_TASK, OPEN_LOOP_TASK = "close_loop/block_picking", "open_loop/block_stacking"
CLOSE_LOOP_ALGORITHMS = ("sac", "sacfd")
SMALL_RUN: dict[str, Any] = {
    "device": "cpu",
    "threads": 1,
    "num_envs": 2,
    "parallel": False,
    "demonstrations": 3,
    "pretrain_updates": 8,
    "total_updates": 30,
    "min_replay": 5,
    "eval_every": 15,
    "eval_episodes": 2,
    "final_eval_episodes": 2,
    "log_every": 1,
    "video_episodes": 0,
    "label": "small",
    "env.obs_size": 64,
    "algorithm.batch_size": 4,
    "algorithm.buffer_size": 1000,
}
SMALL_CLOSE_LOOP = {"env.max_steps": 10}
SMALL_OPEN_LOOP = {"env.max_steps": 6, "algorithm.target_interval": 10}
SMALL_NETWORK: dict[str, dict[str, Any]] = {
    "cnn": {"network.width": 0.25},
    "equi": {"network.n_hidden": 8},
    "equi_small": {"network.n_hidden": 8},
    **{
        name: {"network.width": 0.25, "network.num_rotations": 4}
        for name in ("asr", "equi_asr", "equi_fcn", "fcn", "rot_fcn")
    },
}
NOT_RECORDED = ("run_dir", "resume", "label")
"""Of a run's configuration."""

TRAINING_OPTIONS: dict[str, tuple[str, str, str, dict[str, Any]]] = {
    "uniform": (
        CLOSE_LOOP_TASK,
        "sac",
        "cnn",
        {"algorithm__replay": "uniform", "algorithm__augmentation": "none"},
    ),
    "prioritized sac": (CLOSE_LOOP_TASK, "sac", "cnn", {"algorithm__replay": "prioritized"}),
    "without yaw": (
        CLOSE_LOOP_TASK,
        "sacfd",
        "equi_small",
        {"env__action_sequence": "pxyz", "env__random_orientation": False},
    ),
    "128 pixels": (CLOSE_LOOP_TASK, "sacfd", "cnn", {"env__obs_size": 128}),
    "schedules": (
        CLOSE_LOOP_TASK,
        "sacfd",
        "cnn",
        {
            "algorithm__learning_rate_end_factor": 0.1,
            "algorithm__weight_decay": 1e-4,
            "algorithm__gradient_clamp": 0.1,
            "updates_per_step": 2,
            "report": "best",
        },
    ),
    "quickstart": (CLOSE_LOOP_TASK, "sacfd", "equi_small", {"file": "quickstart"}),
    "quickstart_open_loop": (
        OPEN_LOOP_TASK,
        "sdqfd",
        "equi_asr",
        {"file": "quickstart_open_loop", "env__num_objects": 2},
    ),
    "replay prioritized, se2": (
        OPEN_LOOP_TASK,
        "sdqfd",
        "fcn",
        {"algorithm__replay": "prioritized", "algorithm__augmentation": "se2"},
    ),
    "replay prioritized, d4": (
        OPEN_LOOP_TASK,
        "dqfd",
        "asr",
        {"algorithm__replay": "prioritized", "algorithm__augmentation": "d4"},
    ),
    "replay uniform, translation": (
        OPEN_LOOP_TASK,
        "dqn",
        "asr",
        {"algorithm__replay": "uniform", "algorithm__augmentation": "translation"},
    ),
    "replay split, cn": (
        OPEN_LOOP_TASK,
        "adet",
        "fcn",
        {"algorithm__replay": "symmetric", "algorithm__augmentation": "cn"},
    ),
    "random actions": (
        OPEN_LOOP_TASK,
        "sdqfd",
        "asr",
        {"algorithm__epsilon_init": 0.8, "algorithm__epsilon_end": 0.2},
    ),
    "open loop without yaw": (
        OPEN_LOOP_TASK,
        "sdqfd",
        "equi_fcn",
        {"env__action_sequence": "pxy", "env__random_orientation": False},
    ),
    "whole rotation": (OPEN_LOOP_TASK, "sdqfd", "asr", {"env__half_rotation": False}),
    "in_hand proj": (OPEN_LOOP_TASK, "sdqfd", "asr", {"env__in_hand_mode": "proj"}),
    "deconstruction": (
        "open_loop/house_building_1",
        "sdqfd",
        "fcn",
        {"demonstrations_source": "deconstruction", "only_successful_demonstrations": True},
    ),
    "processes": (CLOSE_LOOP_TASK, "sacfd", "cnn", {"parallel": True}),
}
"""Variants of training: task, algorithm, network and overrides, "__" for a dot."""


@dataclass(frozen=True)
class Case:
    """Something to run and record; it depends on nothing but its fields."""

    name: str
    part: str
    task: str
    kind: str
    """"env", "state", "vector", "parallel", "gym" or "training"."""
    config: dict[str, Any] = field(default_factory=dict)
    """Of the environment; of a training case, its overrides."""
    plan: dict[str, int] = field(default_factory=dict)
    """How many expert episodes, random actions and actions near the expert's."""
    seed: int = SEED


# -- the cases -----------------------------------------------------------------------------------


def cases(parts: Iterable[str], tasks: Iterable[str] | None = None) -> list[Case]:
    """Return the cases of these parts.

    Args:
        parts: of `PARTS`.
        tasks: ids; None for all.
    """
    known = {"envs": _env_cases, "training": _training_cases}
    wanted = None if tasks is None else set(tasks)
    return [
        case
        for part in PARTS
        if part in parts
        for case in known[part]()
        if wanted is None or case.task in wanted
    ]


def _env_cases() -> Iterator[Case]:
    def case(name: str, kind: str, plan: dict[str, int] | None = None, **config: Any) -> Case:
        return Case(f"envs {task} {name}", "envs", task, kind, config, plan or {})

    long = {"expert": 2, "random": 10, "near": 10}
    short = {"expert": 1, "random": 5, "near": 5}
    brief = {"expert": 1, "random": 2, "near": 2}
    for task in ba_torchrl.list_tasks():
        is_open = task.startswith("open_loop")
        turning, fixed = ("pxyr", "pxy") if is_open else ("pxyzr", "pxyz")
        for robot in ROBOTS:
            plan = long if robot == "kuka" else brief if task in SLOW_TASKS else short
            size = {} if robot == "kuka" else {"obs_size": 64}
            yield case(
                f"{robot} {turning}", "env", plan, robot=robot, action_sequence=turning, **size
            )
            yield case(
                f"{robot} {fixed}",
                "env",
                plan,
                robot=robot,
                action_sequence=fixed,
                random_orientation=False,
                obs_size=64,
            )
            if is_open:
                yield case(
                    f"{robot} tilted",
                    "env",
                    plan,
                    robot=robot,
                    action_sequence="pxyzrrr",
                    obs_size=64,
                )
        for name, option in OPTIONS.items():
            plan = brief if task in SLOW_TASKS else short
            yield case(f"option {name}", "env", plan, **{"obs_size": 64, **option})
        if task in VIEW_TASKS:
            for view in VIEWS:
                yield case(f"view {view}", "env", short, view_type=view, obs_size=64)
        yield case("without expert", "env", {"random": 10}, expert=False, obs_size=64)
        yield case("state", "state", obs_size=64)
        yield case("vector", "vector", obs_size=64)
        if task in STEPPED_TOGETHER:
            yield case("parallel", "parallel", obs_size=64)
        yield case("gymnasium", "gym", obs_size=64)


def _training_cases() -> Iterator[Case]:
    """Every algorithm preset with every network preset, and some options."""
    algorithms, networks = (
        sorted(path.stem for path in (CONFIGS / group).glob("*.yaml"))
        for group in ("algorithm", "network")
    )
    pairs = [(algorithm, network) for algorithm in algorithms for network in networks]
    for algorithm, network in pairs:
        task = CLOSE_LOOP_TASK if algorithm in CLOSE_LOOP_ALGORITHMS else OPEN_LOOP_TASK
        yield _training_case(f"{algorithm} {network}", task, algorithm, network)
    for name, (task, algorithm, network, changes) in TRAINING_OPTIONS.items():
        yield _training_case(f"option {name}", task, algorithm, network, **changes)


def _training_case(
    name: str, task: str, algorithm: str, network: str, file: str = "train", **changes: Any
) -> Case:
    small = SMALL_CLOSE_LOOP if task.startswith("close_loop") else SMALL_OPEN_LOOP
    config = {
        "file": file,
        "task": task,
        "algorithm": algorithm,
        "network": network,
        **SMALL_RUN,
        **small,
        **SMALL_NETWORK.get(network, {}),
        **{name.replace("__", "."): value for name, value in changes.items()},
    }
    return Case(f"training {name}", "training", task, "training", config)


# -- what is recorded ----------------------------------------------------------------------------


def digest(*arrays: np.ndarray) -> str:
    """Return 16 hexadecimal digits that stand for the bits, types and shapes of arrays."""
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


def _marks(data: TensorDictBase) -> dict[str, list[Any]]:
    """Return the marks of every entry but those under "next"."""
    return {
        ".".join(key) if isinstance(key, tuple) else key: mark(data[key])
        for key in sorted(data.keys(include_nested=True, leaves_only=True), key=str)
        if key[0] != "next"
    }


def _spec_facts(env: EnvBase) -> dict[str, str]:
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


def _briefly(error: Exception) -> str:
    return " ".join(str(error).split()[:WORDS])


# -- environments --------------------------------------------------------------------------------


class Actions:
    """Actions within a specification, from a generator of their own."""

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
        """Return the expert's action with noise in every other call's components."""
        noise = self.rng.normal(size=self.low.shape) * (self.high - self.low) / 2 * NOISE
        noise *= self.rng.random(self.low.shape) < 0.5
        action = np.clip(expert.numpy().astype(np.float64) + noise, self.low, self.high)
        return torch.from_numpy(action.astype(np.float32))


Choice = Callable[[TensorDictBase], torch.Tensor]


class Trace:
    """Steps as they are recorded."""

    def __init__(self, traces: dict[str, Any], name: str) -> None:
        self.steps: list[dict[str, Any]] = []
        self.facts: dict[str, Any] = {}
        traces[name] = {"facts": self.facts, "steps": self.steps}

    def reset(self, env: EnvBase, **options: Any) -> TensorDictBase:
        """Reset the environment and record what it shows."""
        data = env.reset(**options)
        self.steps.append(_marks(data))
        return data

    def step(self, env: EnvBase, data: TensorDictBase, action: torch.Tensor) -> TensorDictBase:
        """Take a step and record it; return what `torchrl.envs.EnvBase.step` does."""
        data = env.step(data.set("action", action.clone()))
        self.steps.append({"action": mark(data["action"]), **_marks(data["next"])})
        return data

    def end(self, data: TensorDictBase) -> None:
        """Record how an episode came out."""
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


def _run_env(case: Case, facts: dict[str, Any], traces: dict[str, Any]) -> None:
    """Play expert episodes, random actions and actions near the expert's."""
    env = _make(case)
    try:
        facts |= _spec_facts(env)
        facts["max_steps"] = env.max_steps
        actions = Actions(env.action_spec, case.seed, env.action_sequence)
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


def _run_state(case: Case, facts: dict[str, Any], traces: dict[str, Any]) -> None:
    """Go back to a state twice, with the same actions after it."""
    env = _make(case)
    try:
        actions = Actions(env.action_spec, case.seed, env.action_sequence)
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
                trace.steps.append(_marks(data))
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


def _run_vector(case: Case, facts: dict[str, Any], traces: dict[str, Any]) -> None:
    """Step two environments together, with resets of those that are done."""
    env = ba_torchrl.make_vector_env(
        case.task,
        2,
        parallel=case.kind == "parallel",
        **{"seed": case.seed, "expert": True, **case.config},
    )
    try:
        facts |= _spec_facts(env)
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


def _run_gym(case: Case, facts: dict[str, Any], traces: dict[str, Any]) -> None:
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


# -- training ------------------------------------------------------------------------------------


def _composed(case: Case, run_dir: str) -> dict[str, Any]:
    """Return the values that Hydra composes for a training run."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from ba_torchrl.training import hydra_schema

    overrides = dict(case.config)
    file = overrides.pop("file")
    lines = [f"{name}={json.dumps(value)}" for name, value in overrides.items()]
    hydra_schema.register()
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        settings = compose(file, overrides=[*lines, f"seed={case.seed}", f"run_dir={run_dir}"])
    return OmegaConf.to_container(settings, resolve=True)


def _flat(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _tensors(state: Any) -> Iterator[torch.Tensor]:
    """Return the tensors in nested containers."""
    if isinstance(state, torch.Tensor):
        yield state
    elif isinstance(state, dict):
        for value in state.values():
            yield from _tensors(value)
    elif isinstance(state, list | tuple):
        for value in state:
            yield from _tensors(value)


def _tensors_mark(state: Any) -> str:
    """Return what stands for a set of tensors, whatever their names and order."""
    arrays = [tensor.detach().cpu().numpy() for tensor in _tensors(state)]
    marks = "".join(sorted(digest(array) for array in arrays))
    total = sum(float(np.abs(array.astype(np.float64)).sum()) for array in arrays)
    return (
        f"{hashlib.sha256(marks.encode()).hexdigest()[:16]}, {len(arrays)} tensors, "
        f"sum of magnitudes {total:.12g}"
    )


def _run_training(case: Case, facts: dict[str, Any], traces: dict[str, Any]) -> None:
    """Train for a few updates; record every scalar, the last parameters and the evaluation."""
    from ba_torchrl.training.config import ExperimentConfig
    from ba_torchrl.training.experiment import Experiment

    with tempfile.TemporaryDirectory() as folder:
        values = _composed(case, f"{folder}/run")
        facts |= {
            f"config {name}": value
            for name, value in _flat(values)
            if name.split(".")[0] not in NOT_RECORDED
        }
        experiment = Experiment(ExperimentConfig.parse(values), progress=False)
        result = experiment.run()
        with (Path(folder) / "run" / "scalars.csv").open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    steps: dict[str, dict[str, Any]] = {}
    for row in rows:
        steps.setdefault(row["step"], {})[row["name"]] = [row["value"], [float(row["value"])]]
    traces["scalars"] = {"facts": {"updates": " ".join(steps)}, "steps": list(steps.values())}
    facts["updates"] = result.updates
    for name in ("episodes", "success_rate", "mean_length"):
        facts[f"evaluation {name}"] = getattr(result.evaluation, name)
    for name, state in experiment.algorithm.state_dict().items():
        if any(True for _ in _tensors(state)):
            facts[f"tensors of {name}"] = _tensors_mark(state)
    facts["tensors of the policy"] = _tensors_mark(experiment.algorithm.policy.state_dict())


# -- running -------------------------------------------------------------------------------------

RUNNERS: dict[str, Callable[[Case, dict[str, Any], dict[str, Any]], None]] = {
    "env": _run_env,
    "state": _run_state,
    "vector": _run_vector,
    "parallel": _run_vector,
    "gym": _run_gym,
    "training": _run_training,
}


def run_case(case: Case) -> dict[str, Any]:
    """Run a case and return its record: what is refused or fails is recorded as such."""
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
    """Run cases in processes of their own; return their records by name, in the cases' order."""
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
    """Return the versions of what the numbers come from."""
    packages = ("torch", "torchrl", "tensordict", "numpy", "pybullet", "numba", "scipy", "escnn")
    found = {}
    for package in packages:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "none"
    return found


# -- comparing -----------------------------------------------------------------------------------


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return what differs between two records of a case, as lines of text; [] if nothing does."""
    lines = _fact_lines("", old["facts"], new["facts"])
    for name in [*old["traces"], *(name for name in new["traces"] if name not in old["traces"])]:
        before, after = old["traces"].get(name), new["traces"].get(name)
        if before is None or after is None:
            lines.append(f"{name}: only in the {'old' if after is None else 'new'} record")
            continue
        lines += _step_lines(name, before["steps"], after["steps"])
        lines += _fact_lines(f"{name}: ", before["facts"], after["facts"])
    return lines


def _fact_lines(prefix: str, old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    return [
        f"{prefix}{name}: {old.get(name, 'missing')} -> {new.get(name, 'missing')}"
        for name in [*old, *(name for name in new if name not in old)]
        if repr(old.get(name)) != repr(new.get(name))
    ]


def _step_lines(name: str, old: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[str]:
    """Return for every key the first step in which it differs, and the greatest difference."""
    lines = []
    if len(old) != len(new):
        lines.append(f"{name}: {len(old)} -> {len(new)} recorded steps")
    first: dict[str, tuple[int, str]] = {}
    count: dict[str, int] = {}
    greatest: dict[str, float] = {}
    for i, (before, after) in enumerate(zip(old, new, strict=False)):
        for key in [*before, *(key for key in after if key not in before)]:
            if key not in before or key not in after:
                text, size = f"only in the {'old' if key in before else 'new'} record", math.nan
            elif before[key][0] == after[key][0]:
                continue
            else:
                text, size = _size(before[key][1], after[key][1])
            first.setdefault(key, (i, text))
            count[key] = count.get(key, 0) + 1
            greatest[key] = max(greatest.get(key, -math.inf), size)
    for key, (i, text) in sorted(first.items(), key=lambda item: item[1][0]):
        line = f"{name}: step {i}: {key}: {text}"
        if count[key] > 1:
            line += f"; {count[key]} steps differ, by at most {greatest[key]:.3g}"
        lines.append(line)
    return lines


def _size(old: Any, new: Any) -> tuple[str, float]:
    """Return how far two recorded values are apart, in words and as a number."""
    if isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            return f"{len(old)} -> {len(new)} numbers", math.nan
        gaps = [0.0 if repr(a) == repr(b) else abs(a - b) for a, b in zip(old, new, strict=True)]
        size = max(gaps, default=0.0)
        return f"difference {size:.3g}, {_short(old)} -> {_short(new)}", size
    if isinstance(old, list) or isinstance(new, list):
        return "of another size", math.nan
    size = abs(old - new)
    return f"sum differs by {size:.3g} ({old:.9g} -> {new:.9g})", size


def _short(values: list[float]) -> str:
    return "[" + ", ".join(f"{value:.6g}" for value in values) + "]"


def compare(old: dict[str, dict[str, Any]], new: dict[str, dict[str, Any]]) -> dict[str, list[str]]:
    """Return the differences by the name of the case, of those that differ."""
    found = {}
    for name in [*old, *(name for name in new if name not in old)]:
        if name not in old or name not in new:
            found[name] = [f"only in the {'old' if name in old else 'new'} record"]
        elif lines := differences(old[name], new[name]):
            found[name] = lines
    return found


# -- command line --------------------------------------------------------------------------------


def main(arguments: list[str] | None = None) -> int:
    """Record, compare, or both; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, help="file to write the record to")
    parser.add_argument("--compare", type=Path, help="file of an earlier record")
    parser.add_argument("--tasks", help="ids, separated by commas; all if left out")
    parser.add_argument("--parts", help=f"of {','.join(PARTS)}; all, or those of the old record")
    parser.add_argument("--match", default="", help="only cases whose name contains this")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--lines", type=int, default=12, help="to print of each case that differs")
    options = parser.parse_args(arguments)
    if options.out is None and options.compare is None:
        parser.error("give --out, --compare or both")
    old = json.loads(options.compare.read_text()) if options.compare else None
    parts = options.parts.split(",") if options.parts else (old["parts"] if old else PARTS)
    tasks = options.tasks.split(",") if options.tasks else (old["tasks"] if old else None)
    unknown = {*parts} - {*PARTS} | (
        {*(tasks or [])} - {*ba_torchrl.list_tasks()} if not old else set()
    )
    if unknown:
        parser.error(f"unknown: {', '.join(sorted(unknown))}")

    started = time.perf_counter()
    wanted = [case for case in cases(parts, tasks) if options.match in case.name]
    records = run_all(wanted, options.workers)
    seconds = time.perf_counter() - started
    for word in ("refused", "failed"):
        names = [name for name, record in records.items() if word in record["facts"]]
        print(f"{len(names)} cases {word}")
        if old is None:
            for name in names:
                print(f"  {name}: {records[name]['facts'][word]}")
    if options.out is not None:
        content = {
            "parts": list(parts),
            "tasks": tasks,
            "versions": versions(),
            "cases": records,
        }
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(content, separators=(",", ":")) + "\n")
    print(f"{len(records)} cases in {seconds:.0f} s")
    if old is None:
        return 0
    if old["versions"] != versions():
        print(f"versions differ: {old['versions']} -> {versions()}")
    before = {
        name: record
        for name, record in old["cases"].items()
        if record["part"] in parts
        and (tasks is None or record["task"] in tasks)
        and options.match in name
    }
    found = compare(before, json.loads(json.dumps(records)))
    for name, lines in found.items():
        print(name)
        for line in lines[: options.lines]:
            print(f"  {line}")
        if len(lines) > options.lines:
            print(f"  and {len(lines) - options.lines} lines more; see --lines")
    if found:
        print(f"different: {len(found)} of {len(records)} cases")
        return 1
    print(f"equal: {len(records)} cases")
    return 0


if __name__ == "__main__":
    sys.exit(main())
